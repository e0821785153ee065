"""Import of the optional packages of the extra `uncertainty`."""

import importlib
import warnings


def import_optional(name: str):
    """Import an optional package; an ImportError names the extra to install."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # ArviZ announces its next version
            return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is needed here: pip install 'foldgauss[uncertainty]'") from error

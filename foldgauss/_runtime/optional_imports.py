"""Import of packages that only an extra of foldgauss requires."""

import importlib
import warnings


def import_optional(name: str, extra: str):
    """Import an optional package; an ImportError names the extra to install."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # ArviZ announces its next version
            return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{name.partition('.')[0]} is needed here: pip install 'foldgauss[{extra}]'.") from error

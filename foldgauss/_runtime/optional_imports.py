"""Import of packages that only an extra of foldgauss requires."""

import importlib
import warnings


def import_optional(name: str, extra: str):
    """Import an optional package; an ImportError names the extra to install."""
    package = name.partition(".")[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # ArviZ announces its next version
            importlib.import_module(package)
            return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{package} is needed here: pip install 'foldgauss[{extra}]'.") from error

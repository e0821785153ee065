"""`python -m foldgauss` is the command `foldgauss`."""

from foldgauss.cli import main

if __name__ == "__main__":
    main()

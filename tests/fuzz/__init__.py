"""Hostile files against every parser of foldgauss: `python -m tests.fuzz`, and a quick part of it through pytest.

`target` says what a parser promises, `mutate` makes files bad, `branches` watches what a file makes the parser do,
`worker` feeds one target in a process of its own, `__main__` starts the workers and prints the table.
"""

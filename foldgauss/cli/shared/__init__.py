"""What commands share: arguments and their parsing, checks of outputs, clips of models, tables and progress bars."""

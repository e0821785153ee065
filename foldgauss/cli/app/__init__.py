"""The application object, the registry of commands, help, completion and signal handling."""

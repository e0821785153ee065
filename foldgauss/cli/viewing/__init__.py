"""The commands that show models: `render`, `evaluate`, `info` and `view`."""

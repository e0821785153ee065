"""The commands that show models: `render`, `evaluate`, `info`, `figure` and `view`."""

"""The player: one HTML page that holds the model and renders it with WebGL."""

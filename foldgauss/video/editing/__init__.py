"""Edits of a video: a chain of operations, kept as overlays or baked into the model."""

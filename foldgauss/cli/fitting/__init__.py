"""The commands that fit: `fit`, `fit-many`, long clips in segments, their options and progress displays."""

"""Model files: safetensors, compact files, models in segments, selections."""

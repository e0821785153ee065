"""Long videos as segments: one model per span of frames, rendered and edited as one video."""

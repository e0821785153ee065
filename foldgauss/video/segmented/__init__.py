"""Long clips as segments: one model per span of frames, loaded on demand, rendered and edited as one video.

`segmented_video.SegmentedVideo` blends the segments over shared frames, `segmented_edit.SegmentedEdit` is the chain of
edits for it, `layering.layers` stacks videos in segments and others, and `layering.flatten_video` merges layers into
one model where they have no overlays.
"""

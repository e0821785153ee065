"""Clips, images and masks: reading and writing.

`video_reading.read_video` and `video_writing.write_video` convert between files and arrays; `frame_index.index_video`
and `lazy_frames.LazyFrames` give random access to clips that are larger than memory; `masks.read_masks` reads object
masks.
"""

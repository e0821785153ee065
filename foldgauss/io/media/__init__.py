"""Clips, images and masks: reading and writing.

`reading.read_video` and `writing.write_video` convert between files and arrays; `indexing.index_video` and
`indexing.LazyFrames` give random access to clips that are larger than memory; `masks.read_masks` reads object masks.
"""

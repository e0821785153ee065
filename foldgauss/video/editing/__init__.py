"""Edits of a fitted video: select Gaussians, change them, and get a video again.

`chain.edit` starts a chain of edits (`Edit`). Edits that a folded model represents exactly are baked into its
parameters (`bake`); all others stay overlays (`overlays`), applied to the conditioned Gaussians of each frame, with
spans and clocks for their timing (`timing`). `edited_video.EditedVideo` holds layers with their overlays and renders
them.
"""

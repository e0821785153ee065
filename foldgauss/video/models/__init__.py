"""The video model: folded splats and frame times, conditioned on a time, rendered and measured.

`video_model.VideoModel` is the entry point. `splats.FoldedSplats` holds the parameters, `frame_times` maps frames to
times, `conditioning` is the fast CPU form of conditioning on a time, `renderer.VideoRenderer` renders frames,
`metrics.evaluate` scores them.
"""

"""Motion in the image: optical flow, the path of the camera, and videos with a steadier camera.

`optical_flow.Motion` holds the flow of a clip and follows points through it. `camera_path.estimate_camera_path` finds
how the background moves, `shared_motions.find_shared_motions` what the Gaussians of a fit follow, and
`stabilization.stabilize` renders a video as a steadier camera would show it.
`slow_motion.interpolate_frames` renders images between frames.
"""

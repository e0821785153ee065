"""Model files.

`video_model.save_video_model` and `load_video_model` are the entry points; `model_file` stores any registered pytree as
safetensors, `compact` the quantized and entropy-coded models, `segmented` several models of one clip, `checkpoint`
running fits, and `selections` selected Gaussians.
"""

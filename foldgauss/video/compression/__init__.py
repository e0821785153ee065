"""Compression of a model to a small file, within a stated loss of PSNR.

`search.compress` is the entry point. It quantizes the parameters (`quantize`) with steps chosen by `sensitivity`,
reorders the Gaussians (`sort_order`) and fine-tunes the parameters that are not rounded yet (`finetune`).
"""

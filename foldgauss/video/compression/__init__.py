"""Compact models: integers and the way back, and what each Gaussian is worth.

`quantize` maps a model to integers, `streams` encodes them (`range_coder`, `column_contexts`). `quantizer` chooses the
steps by the sensitivity of the images and judges Gaussians. `chunks` divides them into chunks, and `sort_order` sorts
these. `fitting.rate` uses all of it during a fit.
"""

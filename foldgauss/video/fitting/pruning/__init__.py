"""Pruning in rounds between the steps of a fit: `pruner.Pruner` measures what each Gaussian contributes (`scores`),
drops Gaussians and parameters that do not pay (`description_length`), and adds new ones where errors are large
(`births`).
"""

"""House rules of the whole suite: promotion raises, so a shape or dtype slip is a failing test."""

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

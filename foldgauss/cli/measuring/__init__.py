"""The commands that measure: `tradeoff` and `uncertainty`."""

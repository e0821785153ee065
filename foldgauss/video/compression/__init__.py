"""Compact models: quantisation within a stated loss, sort order, sensitivity and fine-tuning."""

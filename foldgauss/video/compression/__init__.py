"""Compact models: quantization within a stated loss, sort order, sensitivity and fine-tuning."""

"""The fitted video: folded splats, frame times, conditioning on a time, rendering, metrics and sparse storage."""

"""Model reduction during a fit: description lengths, scores of parameters, pruning and births."""

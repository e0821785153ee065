"""What is done with a posterior of frame times.

`irregularities` finds duplicated and dropped frames, and `report` and `plots` present the posterior.
"""

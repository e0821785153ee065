"""What is done with a posterior of frame times.

`irregularities` finds duplicated and dropped frames, `report` and `plots` present the posterior, and `calibration`
checks the method by simulation.
"""

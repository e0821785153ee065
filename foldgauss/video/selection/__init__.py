"""Selection of Gaussians: by region, color, time or a click, and tracked through the clip.

`selectors.select` combines all criteria and returns a `Selection`; `contributions.Contributions` measures how much each
Gaussian adds to a rendered image, on which regions, mattes and colors are based; `tracking` carries labels to frames
without a mask.
"""

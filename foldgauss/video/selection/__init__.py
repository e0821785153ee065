"""Selection of Gaussians: by region, colour, time or mask, followed through the clip."""

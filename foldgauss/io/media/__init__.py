"""Videos, images, masks and label maps in and out."""

"""What published data sets need beyond pairs of images: their cameras, and labels of color's pixels."""

"""What SfM tracks tell about exposure: how bright photos are where they show the same points."""

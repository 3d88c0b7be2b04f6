"""The explorer: look at a finished job, exclude or trust pairs and images, and solve its viewing graph again."""

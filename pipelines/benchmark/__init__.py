"""Mappers and stages beside each other: runs in fresh processes, ratios, growth with the number of images."""

"""From a folder of photographs to a COLMAP database: the files are checked, features extracted and matched."""

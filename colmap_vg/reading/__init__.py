"""From the tables of a database to a viewing graph: calibrations, two-view geometries, relative poses."""

"""Read a viewing graph from the tables of a database: calibrations, two-view geometries, relative poses."""

"""The tables and figures of Nasiri et al.: on real 1DSfM folders with truth, or simulated on their topologies."""

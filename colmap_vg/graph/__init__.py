"""Structure of viewing graphs: components, rigidity, cycles, outlier edges."""

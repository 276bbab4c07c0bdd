"""The network of the paper, one file per part of its Fig. 2."""

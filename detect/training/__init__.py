"""Training sets, networks in torch, and how weights are made."""

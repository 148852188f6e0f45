"""Data sets, the networks in torch, their training and export."""

"""What the viewer is made of beside rerun: its protocol, geometry, tables as text, batches, checks."""

"""The paper's network, its training and its estimates. Pure PyTorch; no files, no tracking."""

"""The latent dynamics: graph, network, windows of training data, training and its validation."""

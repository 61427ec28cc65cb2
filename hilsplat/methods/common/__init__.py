"""What several methods share: optimiser, clusters, codebooks, training on rendered pixels."""

"""Code shared by several methods: clusters, codebooks, training on rendered pixels."""

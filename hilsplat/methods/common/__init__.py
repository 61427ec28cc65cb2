"""Code shared by several methods: clusters, codebooks, and training on rendered pixels."""

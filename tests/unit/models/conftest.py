"""A small SAM of transformers."""

from tests.unit.export.conftest import sam_parts, transformers

__all__ = ["sam_parts", "transformers"]

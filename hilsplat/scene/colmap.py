"""pycolmap, loaded after Pillow; import it from here, never directly.

Measured with pycolmap 4.2.1 and Pillow 13.0: if pycolmap is loaded before Pillow's core, writing a PNG with
Pillow corrupts the heap, and the process aborts or hangs. The other order works.
"""

from PIL import Image

# isort: split
import pycolmap

__all__ = ["Image", "pycolmap"]

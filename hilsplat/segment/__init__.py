"""Masks of views at three levels, and coverage trees.

`import` binds `hilsplat.segment` to this package, which is therefore called as the function of that name.
"""

import sys

from hilsplat import CallablePackage

sys.modules[__name__].__class__ = CallablePackage

"""Download of models from the Hugging Face hub.

Files are transferred by plain HTTP unless the user sets `HF_HUB_DISABLE_XET=0`: transfers by Xet often fail
behind proxies and mirrors, and they do not resume.
"""

import os

os.environ.setdefault("HF_HUB_DISABLE_XET", "1")  # read when huggingface_hub is imported

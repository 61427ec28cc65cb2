"""Profile for 2,000 mutations of each format: `pytest --hypothesis-profile mutations tests/damage`."""

from hypothesis import settings

settings.register_profile("mutations", deadline=None, max_examples=2000)

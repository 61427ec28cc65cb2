"""The example of the README fits its images."""

import re
from pathlib import Path

import pytest

import cpusplat


def test_the_example_fits_its_images(capsys):
    pytest.importorskip("torch", reason="torch is not installed")
    page = Path(cpusplat.__file__).with_name("README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.S)
    exec(code, {})
    # a black image has a loss of about 0.12: 31 % of the pixels times the mean colour of 0.4
    assert float(capsys.readouterr().out.split()[1]) < 0.03

"""Run the script of docs/scripts.md on a small run."""

import re
import shutil
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "scripts.md"


def test_the_script_of_the_page_runs(fitted, in_tmp):
    block = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    run = re.search(r'load\("(.*?)"\)', block)[1]
    shutil.copytree(fitted, in_tmp / run)
    made = {}
    exec(compile(block, str(PAGE), "exec"), made)
    assert made["picture"].shape == (32, 32, 3)
    assert (in_tmp / "half.png").is_file()
    assert [picture.shape for picture in made["film"]] == [(64, 64, 3)] * 8
    assert made["paths"].shape[1:] == (5, 3)
    assert made["pixels"].shape == (len(made["paths"]), 2)

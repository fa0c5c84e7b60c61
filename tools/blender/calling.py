"""What the tools of this folder share."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

DROID = Path(__file__).parents[2] / "samples" / "droid.glb"


def blender(python: Path, task: str, **job: Any) -> Any:
    """Have Blender do a task of worker.py; return its answer."""
    call = [str(python), str(Path(__file__).with_name("worker.py")), task, json.dumps(job)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"Blender's part failed:\n{done.stdout}{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])

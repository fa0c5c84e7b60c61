"""What is in an octree texture.

A file opens in milliseconds, whatever its size: it is mapped, and coarse levels come first. A level of it is
a texture of its own, whose leaves are the averages stored there.

    python samples/03_inspect.py [FOLDER]      writes and reads FOLDER/droid.octex (default: out)
"""

import os
import sys
from pathlib import Path

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    octex.convert(MODEL, depth=DEPTH).save(folder / "droid.octex")
    texture = octex.open(folder / "droid.octex")
    texture.validate()  # raises where the file is damaged

    info = texture.info()
    print("channels", {name: channel.format for name, channel in texture.channels.items()})
    print("bytes   ", info["bytes"])
    print("made of ", info["provenance"]["source"])
    for level, (leaves, nodes) in enumerate(texture.tree.cells_by_depth()):
        print(f"level {level:2}: {leaves:9,} leaves {nodes:9,} nodes")

    coarse = texture.level(5)
    nose, antenna, nowhere = [0.0, 0.484, 0.319], [0.088, 1.002, -0.070], [0.0, 0.0, 0.4]
    print("mean colours around the nose and the antenna's end, linear light:")
    print(coarse.sample([nose, antenna]).round(2))
    print("are they in cells, and a point in the air?", coarse.contains([nose, antenna, nowhere]))


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))

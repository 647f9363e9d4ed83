"""Writes the goldens anew: `python tests/golden/make.py`.

They change only in a commit that says which numbers change, by how much and why. A file of `inputs/` that is
missing is trained or taught anew, which changes the numbers of its scene.
"""

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory


def main() -> None:
    """Write `inputs/` where missing, then all of `values/`."""
    import torch
    from chains import Chains, frames, latents, page, results, trained, write, write_inputs
    from configurations import EXPERIMENTS, FEW, PAPER, TAUGHT_WELL, TRAINED

    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        root = Path(folder)
        write_inputs(Chains(root / "trained", TRAINED, TAUGHT_WELL))
        chains = Chains(root / "runs")
        untouched = Chains(root / "runs", FEW)
        write("training", {scene: trained(untouched, scene) for scene in PAPER})
        write("latents", {scene: latents(chains, scene) for scene in PAPER})
        write("results", {name: results(chains, name) for name in EXPERIMENTS})
        write("frames", {"particles": frames(chains, None), "between": frames(chains, 300)})
        write("page", {scene: page(chains, scene, root) for scene in ("sand", "block")})


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    main()

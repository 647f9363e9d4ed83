"""The chain of a job, which several parts of a command ask for its runs."""

import os
from functools import lru_cache
from pathlib import Path

from omegaconf import DictConfig

from nsf.config.composing import Tree
from nsf.pipeline.chain import Pipeline

#: Chains that are held; each takes some hundred KiB.
_MOST = 32


def chain_of(config: DictConfig, root: Path | None = None) -> Pipeline:
    """The chain of a configuration, one object for all who ask what its runs are; none of them works.

    Args:
        config: as `nsf.config.load` gives it.
        root: folder of runs; `NSF_RUNS` or `runs` by default.
    """
    return _chain(Tree(config), root, os.environ.get("NSF_RUNS"), os.environ.get("NSF_REPORTS"))


@lru_cache(maxsize=_MOST)
def _chain(tree: Tree, root: Path | None, _runs: str | None, _reports: str | None) -> Pipeline:
    return Pipeline(tree.config, root=root)

"""Configuration: Hydra groups in `conf/`, composed, checked, and built into objects."""

from nsf.config.composing import checked, names_scene, of_launcher, resolve
from nsf.config.keys import naming_the_missing, replaced, section
from nsf.config.loading import launching, load, read
from nsf.config.sweeps import check_sweep, grammar, jobs, scene_of
from nsf.config.targets import build, build_all
from nsf.scalars import length, number, text

__all__ = [
    "build",
    "build_all",
    "check_sweep",
    "checked",
    "grammar",
    "jobs",
    "launching",
    "length",
    "load",
    "names_scene",
    "naming_the_missing",
    "number",
    "of_launcher",
    "read",
    "replaced",
    "resolve",
    "scene_of",
    "section",
    "text",
]

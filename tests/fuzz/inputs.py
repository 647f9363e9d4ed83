"""Malformed texts, numbers, bytes and files, drawn from a seeded generator."""

import random
import string
from pathlib import Path

import h5py
import numpy as np
import torch

#: Values as a hand types them, or as another program writes them.
VALUES = (
    "nan",
    "inf",
    "-inf",
    "0",
    "-1",
    "1",
    "-0.0",
    "1e-300",
    "1e300",
    "1e999",
    "5e-324",
    "1000000000",
    "-1000000000",
    "18446744073709551616",
    "0.5",
    "true",
    "false",
    "null",
    "''",
    '""',
    "[]",
    "{}",
    "[1]",
    "[nan,0.5,0.13]",
    "[a,b,c]",
    "[1,2]",
    "[1,2,3,4]",
    "[[1,2,3]]",
    "{a:1}",
    "{a:{b:[1,2]}}",
    "???",
    "soft",
    "0x10",
    "1_000",
    "1,5",
    "../../etc/passwd",
    "/dev/zero",
    "/dev/null",
    "~",
    "a/b",
    ".",
    "..",
    "\x00",
    "\x1b[31m",
    "é",
    "\u202e",
    "%s",
    "${scene.dx}",
    "${oc.env:HOME}",
    "${oc.env:PATH,x}",
    "${oc.decode:'1'}",
    "${nope:1}",
    "${scene}",
    "${",
    "$",
    "${oc.create:{a:1}}",
    "<script>",
    "{_target_:nsf.cli.main}",
    "!!python/object:os.system",
    "&a *a",
)

#: Callables of the package and beyond, none of which a configuration may name.
TARGETS = (
    "nsf.storage.Path",
    "nsf.workers.working",
    "nsf.storage.write_json",
    "nsf.storage.writing",
    "nsf.storage.clear_partial",
    "nsf.storage.require_folder",
    "nsf.extras.optional",
    "nsf.cli.main",
    "nsf.runs.Run.open",
    "nsf.runs.Run",
    "nsf.pipeline.Pipeline",
    "nsf.data.TrajectoryWriter",
    "nsf.config.load",
    "nsf.config.build",
    "nsf.paths.groups",
    "nsf.kinematics.manifold.Manifold.load",
    "nsf.errors.NSFError",
    "nsf.mpm.FullOrderMPM",
    "nsf.mpm.wp.config",
    "nsf.scenes.scene.np.save",
    "nsf.scenes.scene.functools.partial",
    "nsf.scenes.shapes.mesh.io.open",
    "nsf.scenes.shapes.mesh.Path",
    "nsf.scenes.Scene.from_config",
    "os.system",
    "os.remove",
    "subprocess.Popen",
    "builtins.eval",
    "builtins.exec",
    "shutil.rmtree",
    "pathlib.Path",
    "pickle.loads",
    "nsf_fuzz_canary.touch",
    "nsf.nsf_fuzz_canary.touch",
    "torch.load",
    "hydra.utils.get_class",
    "nsf",
    "nsf.",
    "nsf..cli",
    "nsf.cli",
    "NSF.cli.main",
    "nsf.scenes",
    "nsf.scenes.",
    "nsf.scenes.__init__",
    "nsf.scenes.Body.__init__",
    "nsf.scenes._points",
    "nsf.scenes.scene._points",
    "nsf.live.server.Stream",
    "nsf.export.command.main",
)

#: Titles, units and names that mean something in HTML, Markdown, LaTeX, a shell or a spreadsheet.
HOSTILE = (
    "<script>nsfcanary()</script>",
    '"><img src=x onerror=nsfcanary()>',
    "'; nsfcanary(); '",
    "</script><nsfcanary>",
    "\n\\write18{touch nsfcanary}\n",
    "\\input{/etc/passwd}",
    "% comment \\immediate",
    "a & b _ ^ ~ # $ { }",
    "[x](javascript:nsfcanary())",
    "![x](http://nsfcanary/x.png)",
    "| a | b |\n|---|---|",
    "`nsfcanary`",
    "<!-- ",
    "]]>",
    "&lt;script&gt;",
    "$\\frac{1}{0}$",
    "$unclosed",
    "=cmd|'/c nsfcanary'!A1",
    "@SUM(1)",
    "\u202enoitcerid",
    "a\tb\rc\nd",
    "\x07",
    "\x1b[2J\x1b]0;nsfcanary\x07",
    "\x9b31m",
    "x" * 3000,
    "${oc.env:HOME}",
    "%(name)s",
    "{{7*7}}",
    "{% raw %}",
    "é\u0301\U0001f525",
)


def mutated(data: bytes, draw: random.Random) -> bytes:
    """The bytes with a few of them changed, cut, repeated or replaced; never the same."""
    for _ in range(100):
        changed, size = bytearray(data), len(data)
        for _ in range(draw.choice((1, 1, 1, 2, 8))):
            at, much = draw.randrange(max(1, len(changed))), draw.choice((1, 1, 4, 64, 1024))
            match draw.randrange(6):
                case 0 if changed:
                    changed[at] ^= 1 << draw.randrange(8)
                case 1:
                    changed[at : at + much] = draw.randbytes(much)
                case 2:
                    del changed[at : at + much]
                case 3:
                    changed[at:at] = changed[at : at + much]
                case 4:
                    del changed[draw.randrange(size + 1) :]
                case 5:
                    changed[at : at + much] = bytes(len(changed[at : at + much]))
        if bytes(changed) != data:
            return bytes(changed)
    return data + b"\0"


def mutated_text(text: str, draw: random.Random) -> str | bytes:
    """A text file with lines moved, values replaced, or in another encoding."""
    lines = text.splitlines()
    for _ in range(draw.choice((1, 1, 2, 5))):
        at = draw.randrange(len(lines)) if lines else 0
        match draw.randrange(9):
            case 0 if lines:
                del lines[at]
            case 1 if lines:
                lines.insert(draw.randrange(len(lines)), lines[at])
            case 2 | 3 | 4 if lines and ":" in lines[at]:
                lines[at] = f"{lines[at].split(':', 1)[0]}: {draw.choice(VALUES)}"
            case 5 if lines:
                lines[at] = " " * draw.randrange(7) + lines[at].lstrip()
            case 6 if lines:
                lines[at] = "".join(draw.choice(string.printable) for _ in range(draw.randrange(60)))
            case 7:
                lines.insert(
                    at, draw.choice(("\t- a", "? [", "<<: *x", "--- ", "a: &a [*a]", "- 5", "x: !!set {1}"))
                )
            case 8:
                encoding = draw.choice(("utf-16", "latin-1", "utf-32"))
                return ("\n".join(lines) + "\né").encode(encoding, "replace")
    return "\n".join(lines) + "\n"


def value_like(old, draw: random.Random):
    """Another value for a place in JSON: of another type, absurd, or hostile."""
    choices = (
        None,
        True,
        -1,
        0,
        5,
        1e308,
        -1e-308,
        2**70,
        "",
        "x",
        [],
        {},
        [old],
        {"a": old},
        "nan",
        "../../x",
        "/etc/passwd",
        draw.choice(HOSTILE),
        draw.choice(VALUES),
        [None] * 3,
        {"": 1},
        "0" * 64,
        "simulate/sand/0",
        "a/b/c/d",
        "//",
    )
    return draw.choice(choices)


def mutated_json(tree, draw: random.Random):
    """A copy of a JSON tree with one place changed, removed or added."""
    import copy

    tree = copy.deepcopy(tree)
    node, path = tree, []
    while isinstance(node, dict | list) and node and (not path or draw.random() < 0.6):
        key = draw.choice(list(node)) if isinstance(node, dict) else draw.randrange(len(node))
        path.append((node, key))
        node = node[key]
    if not path or draw.random() < 0.05:
        return value_like(tree, draw)
    parent, key = path[-1]
    way = draw.random()
    if way < 0.15:
        del parent[key]
    elif way < 0.3 and isinstance(parent, dict):
        parent[draw.choice(HOSTILE)] = parent.pop(key)
    elif way < 0.33:
        for _ in range(draw.choice((40, 300))):
            parent[key] = [parent[key]]
    else:
        parent[key] = value_like(parent[key], draw)
    return tree


def mutated_tensors(tree, draw: random.Random):
    """A copy of a tree of containers and tensors with one leaf changed or gone."""
    if isinstance(tree, dict | list | tuple) and tree and (kept := draw.random() < 0.9):
        copy = dict(tree) if isinstance(tree, dict) else list(tree)
        key = draw.choice(list(copy)) if isinstance(copy, dict) else draw.randrange(len(copy))
        if kept and draw.random() < 0.85:
            copy[key] = mutated_tensors(copy[key], draw)
        else:
            del copy[key]
        return copy
    if isinstance(tree, torch.Tensor) and draw.random() < 0.7:
        nothing = tree.clone().double() * float("nan")
        return draw.choice((tree[..., :0] if tree.ndim else tree[None], tree[None], tree.to(torch.complex64),
                            nothing, tree.bool(), tree.flatten()))  # fmt: skip
    return draw.choice((None, "x", -1, 1e300, [], {}, {"a": 1}, True, float("nan"), 2**40))


def mutated_csv(text: str, draw: random.Random) -> str:
    """A table with a cell, a heading, a column or a row changed."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(draw.choice((1, 1, 2, 8))):
        row, column = draw.randrange(len(rows)), draw.randrange(len(rows[0]))
        match draw.randrange(8):
            case 0:
                rows[0][column] = draw.choice(("x", "", rows[0][0], *HOSTILE))
            case 1:
                for cells in rows:
                    del cells[column : column + 1]
            case 2:
                del rows[row:]
            case 3:
                rows[row] = rows[row][:column]
            case 4:
                rows[row] += ["1"] * draw.choice((1, 5000))
            case 5 | 6 | 7 if len(rows) > 1:
                cells = rows[draw.randrange(1, len(rows))]
                cells[min(column, len(cells) - 1) :][:1] = [draw.choice((*VALUES, *HOSTILE))]
                if cells:
                    cells[min(column, len(cells) - 1)] = draw.choice((*VALUES, *HOSTILE))
        if not rows or not rows[0]:
            break
    return "\n".join(map(",".join, rows)) + "\n"


def spoiled_npz(path: Path, draw: random.Random) -> str:
    """Change one array of a file as its author could; says it."""
    with np.load(path) as stored:
        arrays = dict(stored)
    name, kind = draw.choice(sorted(arrays)), draw.randrange(9)
    values = arrays[name]
    match kind:
        case 0:
            del arrays[name]
        case 1:
            arrays[name] = np.array([None, {}], object)
        case 2:
            kinds = ("S8", "O") if values.dtype.kind == "U" else ("U8", "c16", "?", "f2", "i8", "V4")
            arrays[name] = values.astype(draw.choice(kinds))
        case 3:
            arrays[name] = values[..., :1] if values.ndim else values.reshape(1, 1)
        case 4:
            arrays[name] = values[:0] if values.ndim else values
        case 5:
            arrays[name] = np.full_like(values, np.nan) if values.dtype.kind == "f" else values[..., None]
        case 6:
            arrays[name] = np.zeros((draw.choice((4, 2**27)),), draw.choice(("f8", "u1")))
        case 7:
            arrays[name] = np.concatenate([values, values]) if values.ndim else values
        case 8 if values.dtype.kind == "f":
            arrays[name] = values * draw.choice((1e300, -1e30, 0))
    with np.errstate(all="ignore"):
        np.savez_compressed(path, **arrays)
    return f"{name} changed in the way {kind}"


def spoiled_hdf5(path: Path, draw: random.Random) -> str:
    """Change one thing of an HDF5 file as its author could; says it."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        # Which costs and parameters a run has is its own affair.
        names = [name for name in names if not name.startswith(("cost/", "parameters/"))]
        name, kind = draw.choice(names), draw.randrange(12)
        values = file[name][()]
        is_number = isinstance(values, np.ndarray | np.generic) and values.dtype.kind in "fiu"
        if kind < 3:  # ∞ where a run diverged, and NaN where no bound is known
            kind = {"signal": 0, "bound": 2, "error": 2}.get(name, kind)
        if kind in (0, 1, 2) and is_number:
            values = np.array(values, dtype=float if values.dtype.kind != "f" else values.dtype)
            flat = values.reshape(-1)
            flat[draw.randrange(flat.size)] = (np.nan, np.inf, -np.inf)[kind]
            _replaced(file, name, values)
            return f"{name} has a value that is not finite"
        if kind == 3:
            del file[name]
            return f"{name} is gone"
        if kind == 4:
            _replaced(
                file,
                name,
                np.asarray(values).astype(draw.choice(("S8", "c16", "?", "i1", "f2"))) if is_number else 7,
            )
            return f"{name} is of another type"
        if kind == 5:
            shape = tuple(draw.choice(((), (0,), (3,), (1, 1, 1, 1), (2**20, 2**20, 3))))
            del file[name]
            file.create_dataset(name, shape=shape, dtype="f8", chunks=True if len(shape) > 2 else None)
            return f"{name} has shape {shape}"
        if kind == 6:
            outside = path.with_name("outside.bin")
            outside.write_bytes(bytes(max(1, np.asarray(values).nbytes)) if is_number else b"x")
            shape, dtype = (values.shape, values.dtype) if is_number else ((1,), "u1")
            del file[name]
            if shape:
                file.create_dataset(
                    name, shape=shape, dtype=dtype, external=[(str(outside), 0, h5py.h5f.UNLIMITED)]
                )
            else:
                file[name] = h5py.ExternalLink(str(outside), "/x")
            return f"{name} lies in another file"
        if kind == 7:
            other = path.with_name("other.h5")
            with h5py.File(other, "w") as there:
                there["x"] = values
            del file[name]
            file[name] = h5py.ExternalLink(str(other), "/x")
            return f"{name} is a link to another file"
        if kind == 8:
            other = path.with_name("source.h5")
            with h5py.File(other, "w") as there:
                there["x"] = values
            if is_number and np.ndim(values):
                layout = h5py.VirtualLayout(values.shape, values.dtype)
                layout[...] = h5py.VirtualSource(str(other), "x", values.shape)
                del file[name]
                file.create_virtual_dataset(name, layout)
                return f"{name} is a virtual dataset"
            del file[name]
            return f"{name} is gone"
        if kind == 9 and len(file.attrs):
            attribute = draw.choice(sorted(file.attrs))
            del file.attrs[attribute]
            return f"attribute {attribute} is gone"
        if kind == 10 and len(file.attrs):
            attribute = draw.choice(sorted(set(file.attrs) - {"seconds", "away", "integration_mean"}))
            file.attrs[attribute] = draw.choice((np.nan, -1.0, 0.0, "x", b"\xff", [1, 2], 1e300, np.inf))
            return f"attribute {attribute} is odd"
        if is_number and np.ndim(values) and len(values) > 1:
            _replaced(file, name, values[: len(values) // 2])
            return f"{name} is half as long"
        del file[name]
        return f"{name} is gone"


def _replaced(file: h5py.File, name: str, values) -> None:
    del file[name]
    file[name] = values

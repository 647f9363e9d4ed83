"""C++ and CUDA of Warp functions, a file each, and the function that reads them.

A file is the body of the Warp function whose stub names it, and the stub's signature its list of arguments.
"""

import re
from importlib.resources import files

#: What stands before a body: the name of a type, a number, or several.
Constant = str | bool | int | tuple[int, ...]


def native_code(package: str, name: str, **constants: Constant) -> str:
    """The body of a Warp function, for `wp.func_native`: its constants, then `native/<name>.h` of a package.

    The files that it includes are put in place, since Warp tells by the text whether it must compile anew.

    Args:
        package: which holds the folder `native`.
        name: of the file.
        constants: a text is a type (`real="float"` → `typedef float real;`), a number or a tuple of integers
            a `constexpr`.
    """
    folder = files(package) / "native"

    def text(name: str) -> str:
        code = (folder / f"{name}.h").read_text(encoding="utf-8")
        return re.sub(r'^ *#include "(\w+)\.h"$', lambda match: text(match[1]), code, flags=re.MULTILINE)

    return "\n".join([*(_declared(key, value) for key, value in constants.items()), text(name)])


def _declared(key: str, value: Constant) -> str:
    if isinstance(value, str):
        return f"typedef {value} {key};"
    if isinstance(value, bool):
        return f"constexpr bool {key} = {str(value).lower()};"
    if isinstance(value, tuple):
        return f"constexpr int {key}[] = {{{', '.join(map(str, value))}}};"
    return f"constexpr int {key} = {value};"

"""Back ends and front ends by name: imported when used, open to other packages through entry points.

Another package adds a back end with::

    [project.entry-points."slam.backends"]
    mine = "my_package.module:MyBackend"

Without a package, ``my_module:MyBackend`` is a name as well; the module may be in the working folder.
"""

from __future__ import annotations

import sys
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

from slam.errors import ConfigurationError, SlamError, UnknownNameError, cause, text_of
from slam.naming import suggestion, unknown

#: What this distribution brings, so that a plain checkout works without being installed.
BUILT_IN = {
    "backends": {
        "batch": "backends.batch:BatchBackend",
        "ekf": "backends.ekf:EkfBackend",
        "iekf": "backends.iekf:IekfBackend",
        "smoother": "backends.smoother:SmootherBackend",
        "window": "backends.window:WindowBackend",
    },
    "frontends": {"surf": "frontends.surf:SurfFrontend"},
}

#: Its back ends that estimate frame by frame: what is compared, shown and warmed up where nobody chose.
ONLINE = ("ekf", "smoother", "window")

#: What `slam.interfaces.Backend` and `slam.interfaces.Frontend` ask for.
METHODS = {
    "backends": ("predict", "update", "add", "remove", "estimate", "positions", "trajectory"),
    "frontends": ("extract",),
}


@cache
def _table(role: str) -> dict[str, str]:
    """Name to ``module:attribute``; a built-in name cannot be taken over."""
    registered = {point.name: point.value for point in entry_points(group=f"slam.{role}")}
    return {**registered, **BUILT_IN[role]}


def names(role: str) -> list[str]:
    """Known names of a role, ``"backends"`` or ``"frontends"``, sorted."""
    return sorted(_table(role))


def resolve(role: str, name: str) -> Any:
    """The class (or factory) behind a name, or behind ``module:attribute``.

    Raises:
        UnknownNameError: the name is not known (the message lists the known ones), or its module cannot be imported.
    """
    what, own = _spoken(role), ":" in name
    target = name if own else _table(role).get(name)
    if target is None:
        if name == "simulated":
            known = ", ".join(names(role))
            raise UnknownNameError(f"{what} {name!r} is for worlds in `slam compare` alone; known: {known}")
        own_module = name if Path(f"{name}.py").is_file() else "module"
        raise UnknownNameError(f"{unknown(what, name, names(role))}; or one of your own: {own_module}:Class")
    failed = f"{what} {name!r} cannot be loaded:"
    if not own and name in BUILT_IN[role] and (hidden := _hidden(role)):
        raise UnknownNameError(f"{failed} {hidden}")
    if own and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))  # last: nothing that is installed is replaced
    module, _, attribute = target.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        where, package = "", (error.name or "").partition(".")[0]
        if own and ("/" in module or module.endswith(".py")):
            where = f": give the module's name, {Path(module).stem}:{attribute}, in the folder of its file"
        elif package in BUILT_IN:
            where = f": {_hidden(package) or f'`{package}` is the package of slam, so call yours by another name'}"
        elif own and package == module.partition(".")[0]:
            where = f"; looked for in {Path.cwd()}, where `slam` runs, among the installed packages, and in PYTHONPATH"
        elif own:  # what the module itself imports
            raise UnknownNameError(f"{failed} {cause(error)}") from error
        raise UnknownNameError(f"{failed} {text_of(error)}{where}") from error
    except (ImportError, AttributeError, ValueError, TypeError, SyntaxError) as error:
        near = suggestion(attribute, dir(sys.modules[module])) if module in sys.modules else ""
        raise UnknownNameError(f"{failed} {text_of(error)}{near}") from error
    except (Exception, SystemExit) as error:  # whatever a foreign module does when it is imported
        raise UnknownNameError(f"{failed} {cause(error)}") from error


def _spoken(role: str) -> str:
    return role[:-1].replace("end", " end")


def _hidden(package: str) -> str:
    """What hides `backends` or `frontends` of this distribution, in words; empty where nothing does."""
    spec = find_spec(package)
    if spec is None:
        return ""
    hiding = Path(next(iter(spec.submodule_search_locations or [str(spec.origin)]))).resolve()
    if hiding.parent == Path(__file__).resolve().parents[1]:
        return ""
    return f"{hiding} hides slam's own `{package}`: rename it"


def create(role: str, name: str, rig: Any, /, **options: Any) -> Any:
    """An instance by name, for a rig, with its options.

    Raises:
        UnknownNameError: see `resolve`.
        ConfigurationError: an option is unknown or out of its range; or the class cannot be created like that, or lacks
            methods of its protocol (they are named).
    """
    what, made = f"{_spoken(role)} {name!r}", resolve(role, name)
    if options.get("models", options) is None:  # as where a class hands on its own default
        del options["models"]
    try:
        created = made(rig, **options)
    except SlamError as error:
        own = list(options_of(made, rig))
        wrong = next((option for option in options if option not in [*own, "models"]), "")
        if wrong and own:
            raise ConfigurationError(f"{what}: {unknown('option', wrong, own)}") from error
        raise
    except (Exception, SystemExit) as error:  # whatever a foreign class does
        known = ", ".join(options_of(made, rig))
        hint = f"; its options are {known}" if known and isinstance(error, TypeError) else ""
        raise ConfigurationError(f"{what} cannot be created: {cause(error)}{hint}") from error
    return require_methods(role, created, repr(name))


def options_of(made: Any, rig: Any) -> dict[str, tuple[Any, Any]]:
    """Options of a back end's or front end's class: by name the default, and what has them in its docstring.

    They are the arguments of its constructor but the rig, ``models``, and functions, and where that takes any others
    the fields of its ``config``.
    """
    try:
        parameters = list(signature(made).parameters.values())[1:]
        named = (p for p in parameters if p.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY))
        values = {p.name: None if p.default is Parameter.empty else p.default for p in named if p.name != "models"}
        found = {name: (value, made) for name, value in values.items() if not callable(value)}
        config = getattr(made(rig), "config", None) if any(p.kind is p.VAR_KEYWORD for p in parameters) else None
        of_config = fields(config) if is_dataclass(config) else ()
        return found | {f.name: (getattr(config, f.name), type(config)) for f in of_config}
    except (Exception, SystemExit):  # noqa: BLE001 (whatever a foreign class does)
        return {}


def require_methods(role: str, part: Any, name: str = "") -> Any:
    """A back end or front end, or None for no front end; raises ConfigurationError where it lacks a method."""
    if isinstance(part, type):
        made = f"{part.__name__}(rig.rectified.rig)" if role == "backends" else f"{part.__name__}(rig)"
        raise ConfigurationError(f"{_spoken(role)} {part.__name__} is a class: give an instance, such as {made}")
    own = getattr(part, "__wrapped__", part)  # behind `slam.guarded`, which makes two of them where they are not there
    guarded = () if own is part else ("positions", "trajectory")
    missing = [method for method in METHODS[role] if not callable(getattr(own, method, None)) and method not in guarded]
    if missing and (part is not None or role == "backends"):
        what = f"{_spoken(role)} {name or type(part).__name__}"
        raise ConfigurationError(f"{what} is none: it lacks {', '.join(missing)}")
    return part

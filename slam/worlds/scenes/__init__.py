"""The built-in worlds, a module each: ``TEXT``, ``OPTIONS``, ``DEFAULTS`` and ``build(values) -> World``."""

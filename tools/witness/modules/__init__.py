"""All cases by name. Every file of this folder with a dictionary CASES {name: function(case)} is included."""

import importlib
import pkgutil

CASES = {}
for _, _name, _ in sorted(pkgutil.iter_modules(__path__), key=lambda m: m.name):
    _found = getattr(importlib.import_module(f"{__name__}.{_name}"), "CASES", {})
    assert not set(_found) & set(CASES), _name
    CASES |= _found

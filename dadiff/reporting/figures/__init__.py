"""The kinds of figures, one module each.

A module `kind.py` offers `collect(evidence, **options)`, which returns a frozen dataclass of what is plotted
(`runs`: keys of the runs; `notes`: what a reader must know) with a method `draw(columns)` that renders it.
A report's definition names the module as `kind` and gives the options. A new kind is one new module; outside of dadiff
it is one class with `collect` as a class method, whose dotted name is the `kind`.
"""

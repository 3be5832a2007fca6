"""What the server that jobs are forked from has loaded: what most jobs use, and not MLflow, which no job talks to.

None of it is garbage, so it is never looked through: not as it loads, nor in a job, which would copy what it looks at.
"""

import gc
from importlib import import_module

from dadiff.running.provenance import commit

MODULES = (
    *("dadiff.cli", "dadiff.running.experiment", "dadiff.tracking"),
    *("pyarrow.parquet", "pyarrow.pandas_compat", "pydantic.dataclasses"),  # which their users import late
)

gc.disable()
for name in MODULES:
    import_module(name)
commit()
gc.freeze()
gc.enable()

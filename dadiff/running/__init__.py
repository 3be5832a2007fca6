"""The orchestrator: one run, from configuration to stored result.

identity says what determines a run, assembly builds its components, experiment draws and evaluates its plans,
provenance says where a result comes from, summary shows runs in the terminal.
"""

"""The report: evidence for every claim of the paper, with intervals, from stored runs.

    sources      reads a sweep from the results folder or from MLflow
    aggregation  groups its cells into methods and pairs them with what they are compared to
    statistics   intervals and bands: pure functions of arrays
    figures      one module a kind of figure: collects numbers, draws them
    tables, claims
    render       HTML, LaTeX, CSV and report.json

Nothing here runs a model: torch is never imported.
"""

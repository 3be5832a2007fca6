"""Tables as LaTeX, by hand: everything from a store is escaped, numbers are set in maths."""

from __future__ import annotations

import re

from dadiff.reporting.labels import SUPERSCRIPT, metric_name, with_interval
from dadiff.reporting.tables import Row, Table, Value

SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "†": r"$^\dagger$", "‖": r"$\|$", "²": r"$^2$", "·": r"$\cdot$", "×": r"$\times$", "σ": r"$\sigma$",
    "Γ": r"$\Gamma$", "−": "$-$", "–": "--", "∞": r"$\infty$", "°": r"$^\circ$",
}  # fmt: skip
CONTROL = re.compile(r"[\x00-\x1f\x7f]")
NORMAL = {ord(raised): chr(plain) for plain, raised in ((k, chr(v)) for k, v in SUPERSCRIPT.items())}


def escape(text: str) -> str:
    """Text for LaTeX: its special characters, and the signs that this report uses, as commands; line ends as spaces.

    Example:
        >>> escape("a_b & 50 %")
        'a\\\\_b \\\\& 50 \\\\%'
    """
    raised = re.sub(
        r"10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", lambda m: f"10\0{m[1].translate(NORMAL)}\1", " ".join(CONTROL.sub(" ", text).split())
    )
    escaped = "".join(SPECIAL.get(character, character) for character in raised)
    return escaped.replace("\0", "$^{").replace("\1", "}$")


def to_latex(table: Table, caption: str, label: str) -> str:
    """A `table` environment with rules of booktabs."""
    head = " & ".join(["method", *(escape(metric_name(metric)) for metric in table.metrics)])
    body = [_row(row, table.metrics) for row in table.rows]
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{escape(caption)}}}\label{{tab:{escape(label)}}}",
            rf"\begin{{tabular}}{{l{'l' * len(table.metrics)}}}",
            r"\toprule",
            rf"{head} \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _row(row: Row, metrics: list[str]) -> str:
    if not row.runs:
        return rf"{escape(row.label)} & \multicolumn{{{max(1, len(metrics))}}}{{l}}{{{escape(row.outcome)}}} \\"
    return " & ".join([escape(row.label), *(escape(_value(row.values[metric])) for metric in metrics)]) + r" \\"


def _value(value: Value | None) -> str:
    return with_interval(value.mean.value, value.mean.low, value.mean.high) if value else "–"

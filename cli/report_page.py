"""A report as one HTML page that needs nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

from ..schemas.software import SOFTWARE

_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;"
    "color:#222;background:#fff}table{border-collapse:collapse;display:block;overflow-x:auto}"
    "th,td{padding:.3rem .8rem;border-bottom:1px solid #ccc;text-align:right}"
    "th:first-child,td:first-child{text-align:left}"
    "@media(prefers-color-scheme:dark){body{background:#181818;color:#ddd}th,td{border-color:#444}}"
)
_NAMES = {"unfiltered": "unfiltered (the paper's)", "truth": "truth", "temporal_mean": "temporal mean"}


def denoise_page(value: Mapping[str, Any]) -> str:
    """The page of ``turnscan report denoise``, from what it writes with --json."""
    references = value["references"]
    head = "".join(f'<th colspan="3">against {escape(_NAMES[n])}</th>' for n in references)
    units = "<th>PSNR, dB</th><th>MSE, DN²</th><th>SNR, dB</th>" * len(references)
    body = "".join(
        f"<tr><td>{escape(row['filter'])}</td>"
        + "".join(
            f"<td>{_number(row[f'{kind}_vs_{n}_{unit}'])}</td>"
            for n in references
            for kind, unit in (("psnr", "db"), ("mse", "dn2"), ("snr", "db"))
        )
        + "</tr>"
        for row in value["rows"]
    )
    meaning = "".join(
        f"<dt>{escape(_NAMES[n])}</dt><dd>{escape(t)}</dd>" for n, t in references.items()
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>Denoising, {escape(value['scan'])}</title>"
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style>'
        f"<h1>Denoising</h1><p>{value['frames']} frames of {escape(value['scan'])}; "
        f"PSNR = 10 log<sub>10</sub>({value['peak_dn']:g}² / MSE), over all pixels of all frames; "
        "SNR has the mean square of the filtered frames for the peak.</p>"
        f"<table><tr><th></th>{head}</tr><tr><th>filter</th>{units}</tr>{body}</table>"
        f"<h2>What each is measured against</h2><dl>{meaning}</dl>"
        f"<p><small>{escape(SOFTWARE)}</small></p></html>\n"
    )


def _number(value: float | None) -> str:
    if value is None:
        return "none"
    return "∞" if math.isinf(value) else f"{value:.4f}"

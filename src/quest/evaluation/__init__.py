"""Protocols, metrics, tables."""

from quest.evaluation.records import Discovery, EntityRecord, Subject, Unscored, read_records
from quest.evaluation.results import Results, Run, read_results, write_results
from quest.evaluation.runner import evaluate
from quest.evaluation.summary import Metrics, Row, summarise
from quest.evaluation.tables import results_table

__all__ = [
    "Discovery",
    "EntityRecord",
    "Metrics",
    "Results",
    "Row",
    "Run",
    "Subject",
    "Unscored",
    "evaluate",
    "read_records",
    "read_results",
    "results_table",
    "summarise",
    "write_results",
]

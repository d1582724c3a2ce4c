"""Data to fit: the two tables of the robust regression literature that the demo and the tests use."""

from maxcon.datasets.classic import TABLES, Table, belgian_calls, cyg_ob1, load_table

__all__ = ["TABLES", "Table", "belgian_calls", "cyg_ob1", "load_table"]

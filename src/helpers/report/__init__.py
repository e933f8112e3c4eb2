"""What is shown: figures, tables, verdicts, findings, the report, and their publication. Nothing below imports it."""

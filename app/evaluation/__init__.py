"""Evaluation against ground truth: methods, scores, tables, figures and tuning."""

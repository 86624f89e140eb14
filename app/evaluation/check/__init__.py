"""Checks exports for consistency."""

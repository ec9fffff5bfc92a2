"""The parsers under test."""

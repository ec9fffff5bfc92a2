"""The figures of a comparison, drawn once, and written as PDF, PNG and, for the page, SVG."""

"""Notebooks in a kernel of their own, as Jupyter runs them."""

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook


def executed(
    cells: Sequence[str], folder: Path, interrupt: Callable[[], bool] | None = None
) -> nbformat.NotebookNode:
    """The notebook of these cells with what they showed; errors are kept as outputs.

    Args:
        cells: Their code.
        folder: The folder that they run in.
        interrupt: The kernel is interrupted, once, when this is true.
    """
    notebook = new_notebook(cells=[new_code_cell(text) for text in cells])
    client = NotebookClient(
        notebook,
        timeout=250,
        kernel_name="python3",
        allow_errors=True,
        resources={"metadata": {"path": str(folder)}},
    )
    asyncio.run(_execute(client, interrupt))
    return notebook


async def _execute(client: NotebookClient, interrupt: Callable[[], bool] | None) -> None:
    running = asyncio.create_task(client.async_execute())
    if interrupt is not None:
        deadline = time.monotonic() + 200
        while not (interrupt() or running.done()) and time.monotonic() < deadline:
            await asyncio.sleep(0.02)
        await client.km.interrupt_kernel()
    await running


def errors(notebook: nbformat.NotebookNode) -> list[str]:
    """`Error: message` of each cell that ended in one."""
    outputs = [output for cell in notebook.cells for output in cell.outputs]
    found = [each for each in outputs if each.output_type == "error"]
    return [f"{each.ename}: {each.evalue}" for each in found]


def shown(cell: nbformat.NotebookNode, stream: str) -> str:
    """What a cell wrote to stdout or stderr."""
    texts = [o.text for o in cell.outputs if o.output_type == "stream" and o.name == stream]
    return "".join(texts)

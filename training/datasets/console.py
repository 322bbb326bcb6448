"""The console of the commands. It prints the names in data files as they are."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from scene_client.untrusted import printable, printable_lines


class _Console(Console):
    """A console for texts of others: it escapes control characters, and reads no markup."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield the parts of the output: also those of tables, progress bars and states."""
        for segment in super().render(renderable, options):
            is_safe = segment.control or segment.text.isprintable()
            yield segment if is_safe else segment._replace(text=printable_lines(segment.text))


console = _Console(markup=False, emoji=False)


def print_lines(*lines: str) -> None:
    """Print texts, each on one line, without colours."""
    for line in lines:
        console.print(printable(line), highlight=False, soft_wrap=True)


def print_marked(mark: str, colour: str, text: str) -> None:
    """Print a coloured word, such as "error:", and a text."""
    console.print(Text.assemble((mark, colour), " ", text), soft_wrap=True)

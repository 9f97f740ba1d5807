"""Where light is: what lets a propagation step leave out rows and ends of rows, as text for its kernels.

For every row of cells along x a buffer has a span [begin, end) outside of which it is zero. A step computes a row only where
one of the nine rows around it (itself included) has light, plus one cell at each end, and only inside the box of cells that
can still reach what is read after it; elsewhere it writes zeros where the buffer it writes to held light two steps ago, and
touches nothing otherwise. It notes the span of what it wrote, found by looking at the values: light that a wall stops does not
widen it. Values are those of a step that leaves out nothing, bit for bit, wherever the box matters.

Beside the spans a step leaves the sum of |S_0| of each row: adding those up costs a thousandth of a step.

Arrays: ``lit``, ``lit_next`` [groups, rows, 2] of S and S', rows of the halo empty; ``needed`` [steps, 6], the box
z, y, x as (begin, end) pairs after each step; ``moved`` [groups, n_z, n_y]. On CUDA, where a thread has one cell, and in the
adjoint all of it is left out.
"""

import re

__all__ = ["fill_spans"]

_BEGIN = """
    const long long span_at = 2 * (SPAN_GROUP * ((long long)(z_size + 2) * pitch_y + 1) + line);
    const int* box = needed.data + 6 * step;
    int lit_begin = x_size, lit_end = 0, new_begin = x_size, new_end = 0;
    for (int dz = -1; dz <= 1; ++dz)
        for (int dy = -1; dy <= 1; ++dy) {
            const int* span = lit.data + span_at + 2 * (dz * pitch_y + dy);
            if (span[0] < lit_begin) lit_begin = span[0];
            if (span[1] > lit_end) lit_end = span[1];
        }
    if (lit_begin < lit_end) {
        lit_begin = lit_begin - 1 > box[4] ? lit_begin - 1 : box[4];
        lit_end = lit_end + 1 < box[5] ? lit_end + 1 : box[5];
    }
    if (z < box[0] || z >= box[1] || y < box[2] || y >= box[3] || lit_begin >= lit_end) lit_end = -1;
    const int old_begin = lit_next.data[span_at], old_end = lit_next.data[span_at + 1];
    V moved_sum = zero;
"""

_SKIP = """
        if (x + LANES <= lit_begin || x >= lit_end) {
            SCALAR* dark = next.data + SPAN_AT;
            if (x < old_end && x + LANES > old_begin)
                for (int i = 0; i < SPAN_FIELDS; ++i, dark += pitch) {
                    *(V*)dark = zero;
                    if (x == 0) dark[-1] = 0;
                    if (x + LANES >= x_size) dark[LANES] = 0;
                }
            continue;
        }
"""

_NOTE = """
        {
            const SCALAR* written = next.data + SPAN_AT;
            for (int i = 0; i < SPAN_FIELDS; i += COEFFS) {
                const V value = *(const V*)(written + i * pitch);
                moved_sum += value > zero ? value : -value;
            }
            const int last = x + LANES < x_size ? x + LANES : x_size;
            for (int cell = x; cell < last && cell < new_begin; ++cell)
                for (int i = 0; i < SPAN_FIELDS; ++i)
                    if (written[i * pitch + cell - x] != 0) new_begin = cell;
            for (int cell = last; cell > x && cell > new_end; --cell)
                for (int i = 0; i < SPAN_FIELDS; ++i)
                    if (written[i * pitch + cell - 1 - x] != 0) new_end = cell;
        }
"""

_END = """
    lit_next.data[span_at] = new_begin;
    lit_next.data[span_at + 1] = new_end;
    SCALAR moved_total = 0;
    for (int lane = 0; lane < LANES; ++lane) moved_total += moved_sum[lane];
    moved.data[((long long)SPAN_GROUP * z_size + z) * y_size + y] = moved_total;
"""


def fill_spans(text: str, *, used: bool, group: str, fields: int, at: str) -> str:
    """``text`` with its marks ``SPANS_BEGIN``, ``_SKIP``, ``_NOTE`` and ``_END`` filled in, or taken out.

    Args:
        text: of a native snippet that loops over x in chunks of ``LANES``.
        used: False takes them out.
        group: expression of the channel group.
        fields: scalar fields that one pass through the loop writes, COEFFS for each channel.
        at: expression of the first field's offset in ``next`` inside the loop.
    """
    for name, part in {"BEGIN": _BEGIN, "SKIP": _SKIP, "NOTE": _NOTE, "END": _END}.items():
        filled = part.replace("SPAN_GROUP", group).replace("SPAN_FIELDS", str(fields)).replace("SPAN_AT", at)
        text = re.sub(rf"\bSPANS_{name}\b", lambda _, filled=filled: filled if used else "", text)
    return text

"""The two subsets of the context views that the consistency loss compares."""


def subsets(frames, step):
    """frames: the frame number of each context view, in any order -> two lists of indices into it, of one length.

    Ordered by frame, the first and the last view go to both. Those between alternate: counted from 0 over the whole
    order, odd positions go to a and even ones to b, the other way round on odd steps. The smaller list repeats its
    last. With fewer than two views there is nothing to compare: None.
    """
    if len(frames) < 2:
        return None
    order = sorted(range(len(frames)), key=lambda i: frames[i])
    first, middle, last = order[0], order[1:-1], order[-1]
    a = [first, *middle[0::2], last]
    b = [first, *middle[1::2], last]
    if step % 2 == 1:
        a, b = b, a
    size = max(len(a), len(b))
    a += [a[-1]] * (size - len(a))
    b += [b[-1]] * (size - len(b))
    return a, b

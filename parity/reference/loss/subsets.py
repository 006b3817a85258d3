"""Selection of the two subsets of the context views that the consistency loss compares."""


def subsets(frames, step):
    """Returns two lists of equal length of indices into `frames`, the frame numbers of the context views in any order.

    In order of frames, the first and the last view are in both subsets, and those between alternate: with positions
    from 0 in the whole order, odd ones go to a and even ones to b, and vice versa on odd steps. The smaller list
    repeats its last element. Returns None for fewer than two views.
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

"""Color jitter as torchvision's functional transforms define it on floating-point images [3, H, W] in [0, 1]."""

import torch


def grey(image):
    """Converts an image to greyscale, [1, H, W]."""
    red, green, blue = image.unbind(0)
    return (0.2989 * red + 0.587 * green + 0.114 * blue)[None]


def blend(image, other, ratio):
    return (ratio * image + (1.0 - ratio) * other).clamp(0.0, 1.0)


def brightness(image, factor):
    return blend(image, torch.zeros_like(image), factor)


def contrast(image, factor):
    return blend(image, grey(image).mean(), factor)


def saturation(image, factor):
    return blend(image, grey(image), factor)


def rgb_to_hsv(image):
    red, green, blue = image.unbind(0)
    largest, least = image.amax(0), image.amin(0)
    same = largest == least
    chroma = largest - least
    saturation = chroma / torch.where(same, torch.ones_like(largest), largest)
    divisor = torch.where(same, torch.ones_like(largest), chroma)
    rc, gc, bc = (largest - red) / divisor, (largest - green) / divisor, (largest - blue) / divisor
    hue = (largest == red) * (bc - gc)
    hue = hue + ((largest == green) & (largest != red)) * (2.0 + rc - bc)
    hue = hue + ((largest != green) & (largest != red)) * (4.0 + gc - rc)
    return torch.fmod(hue / 6.0 + 1.0, 1.0), saturation, largest


def hsv_to_rgb(hue, saturation, value):
    sector = torch.floor(hue * 6.0)
    f = hue * 6.0 - sector
    p = (value * (1.0 - saturation)).clamp(0.0, 1.0)
    q = (value * (1.0 - saturation * f)).clamp(0.0, 1.0)
    t = (value * (1.0 - saturation * (1.0 - f))).clamp(0.0, 1.0)
    sector = sector.long() % 6
    colors = [(value, t, p), (q, value, p), (p, value, t), (p, q, value), (t, p, value), (value, p, q)]
    choices = torch.stack([torch.stack(color) for color in colors])  # [6, 3, H, W]
    return choices.gather(0, sector[None, None].expand(1, 3, *sector.shape))[0]


def hue(image, turn):
    h, s, v = rgb_to_hsv(image)
    return hsv_to_rgb((h + turn) % 1.0, s, v)


ADJUSTMENTS = {"brightness": brightness, "contrast": contrast, "saturation": saturation, "hue": hue}


def jitter(image, adjustments):
    """Applies `adjustments`, [(name, factor)], in order."""
    for name, factor in adjustments:
        image = ADJUSTMENTS[name](image, factor)
    return image

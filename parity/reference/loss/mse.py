"""Mean squared error over all elements."""


def mse(image, target):
    return ((image - target) ** 2).mean()

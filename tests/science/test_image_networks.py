"""Encoder and decoder of images: shapes, layouts, and an image that they can learn by heart."""

import pytest
import torch

from models.networks.image import ImageDecoder, ImageEncoder, as_bytes, camera_size, split, squared_error, stacked
from models.networks.initialisation import initialise
from models.spaces import StreamSpec


def _autoencoder(size: int, channels: int) -> torch.nn.Sequential:
    encoder = ImageEncoder(size, channels, depth=8)
    network = torch.nn.Sequential(encoder, ImageDecoder(encoder.outputs, size, channels, depth=8))
    initialise(network, torch.Generator().manual_seed(0))
    return network


@pytest.mark.parametrize(("size", "features"), [(64, 4096), (16, 1024), (8, 512)])
def test_features_and_pixels_have_the_stated_shapes(size: int, features: int) -> None:
    encoder = ImageEncoder(size, 6, depth=32)
    decoder = ImageDecoder(100, size, 6, depth=32)
    initialise(encoder, torch.Generator())
    initialise(decoder, torch.Generator())
    assert encoder(torch.zeros(2, size, size, 6)).shape == (2, features) == (2, encoder.outputs)
    assert decoder(torch.zeros(2, 100)).shape == (2, size, size, 6)


def test_two_images_are_learned_by_heart() -> None:
    network = _autoencoder(16, 3)
    image = torch.zeros(2, 16, 16, 3)
    image[0, 2:6, 3:7], image[1, 8:12, 5:9] = 1.0, torch.tensor((1.0, 0.5, 0.0))
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    for _ in range(100):
        optimiser.zero_grad()
        squared_error(network(image), image).sum().backward()  # type: ignore[no-untyped-call]  # untyped in torch
        optimiser.step()
    assert float(squared_error(network(image), image).detach().sum()) / image.numel() < 1e-3


def test_an_image_does_not_depend_on_the_others_of_its_batch() -> None:
    network = _autoencoder(16, 6)
    images = torch.rand(5, 16, 16, 6, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(network(images)[3], network(images[3:4])[0])


def test_cameras_are_stacked_and_split_without_loss() -> None:
    draw = torch.Generator().manual_seed(0)
    seen = {name: torch.randint(256, (2, 3, 8, 8, 3), generator=draw).byte() for name in ("front", "wrist")}
    pixels = stacked(seen, ("front", "wrist"))
    assert pixels.shape == (2, 3, 8, 8, 6)
    back = split(pixels, ("front", "wrist"))
    assert all(torch.equal(as_bytes(back[name]), seen[name]) for name in seen)


def test_pixels_out_of_range_are_black_or_white() -> None:
    assert as_bytes(torch.tensor([-0.2, 0.0, 0.5, 1.0, 1.3])).tolist() == [0, 0, 128, 255, 255]


@pytest.mark.parametrize(
    ("shape", "dtype"), [((48, 48, 3), "uint8"), ((64, 32, 3), "uint8"), ((4, 4, 3), "uint8"), ((64, 64, 3), "float32")]
)
def test_other_images_are_refused(shape: tuple[int, ...], dtype: str) -> None:
    with pytest.raises(ValueError, match=r"Images must all be uint8 \(S, S, 3\).*got {'front': '"):
        camera_size({"front": StreamSpec(shape, dtype)})


def test_cameras_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="Images must all be"):
        camera_size({"front": StreamSpec((64, 64, 3), "uint8"), "wrist": StreamSpec((32, 32, 3), "uint8")})

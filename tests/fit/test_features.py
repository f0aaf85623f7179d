"""The feature network: NumPy convolutions, the shipped weights, every way in which weights can be wrong."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.numpy import load_file, save_file
from small_network import picture, small_net, tensors

from usdfab.errors import UsdfabError
from usdfab.fit import weights_file
from usdfab.fit.features import encode_srgb, fast_dtype, load_features
from usdfab.srgb import linear_to_srgb


def convolved(image: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """ReLU of the 3x3 correlation of (C, H, W) with (O, C, 3, 3), zero-padded."""
    windows = sliding_window_view(np.pad(image, ((0, 0), (1, 1), (1, 1))), (3, 3), axis=(1, 2))
    return np.maximum(np.einsum("cyxij,ocij->oyx", windows, weight) + bias[:, None, None], 0.0)


def pooled(image: np.ndarray, how: str) -> np.ndarray:
    """(C, H, W) reduced to half."""
    channels, height, width = image.shape
    blocks = image[:, : height // 2 * 2, : width // 2 * 2].reshape(channels, height // 2, 2, width // 2, 2)
    return blocks.mean(axis=(2, 4)) if how == "average" else blocks.max(axis=(2, 4))


def caffe_input(linear: np.ndarray) -> np.ndarray:
    """What the original networks take: B, G, R, 0 to 255, less their mean."""
    return linear_to_srgb(linear)[::-1] * 255.0 - np.array([103.939, 116.779, 123.68])[:, None, None]


@pytest.mark.parametrize("pooling", ["average", "maximum"])
def test_equals_a_numpy_network(tmp_path: Path, pooling: str) -> None:
    net = small_net(tmp_path, pooling=pooling)
    image = picture(1, 18, 21)
    first, last = net(image)
    weights = tensors()
    layer = {n: (weights[f"{n}.weight"], weights[f"{n}.bias"]) for n in ("conv1_1", "conv1_2", "conv2_1")}
    expected_first = convolved(caffe_input(image[0].numpy()), *layer["conv1_1"])
    expected_last = convolved(pooled(convolved(expected_first, *layer["conv1_2"]), pooling), *layer["conv2_1"])
    assert net.taps == ("conv1_1", "conv2_1") and net.channels == (4, 6) and net.reduction == 2
    np.testing.assert_allclose(first[0].numpy(), expected_first, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(last[0].numpy(), expected_last, rtol=1e-12, atol=1e-12)


def test_the_shipped_network_equals_numpy_to_its_second_block() -> None:
    weights = {k: v.astype(np.float64) for k, v in load_file(weights_file.SHIPPED).items()}
    image = picture(2, 16, 16)
    net = load_features(dtype=torch.float64, taps=("conv1_1", "conv1_2", "conv2_1"))
    x = caffe_input(image[0].numpy())
    for name, found in zip(net.taps, net(image), strict=True):
        if name == "conv2_1":
            x = pooled(x, "average")
        x = convolved(x, weights[f"{name}.weight"], weights[f"{name}.bias"])
        np.testing.assert_allclose(found[0].numpy(), x, rtol=1e-9, atol=1e-8)


def test_the_shipped_network_is_the_one_on_its_card() -> None:
    digest = hashlib.sha256(weights_file.SHIPPED.read_bytes()).hexdigest()
    assert digest == weights_file.SHIPPED_SHA256
    card = weights_file.SHIPPED.with_suffix(".md").read_text(encoding="utf-8")
    assert digest in card and "Simonyan" in card and "Attribution" in card
    net = load_features()
    assert net.taps == ("conv1_1", "conv2_1", "conv3_1", "conv4_1")
    assert net.channels == (64, 128, 256, 512) and net.reduction == 8
    shapes = [tuple(m.shape) for m in net(torch.full((2, 3, 24, 16), 0.5))]
    assert shapes == [(2, 64, 24, 16), (2, 128, 12, 8), (2, 256, 6, 4), (2, 512, 3, 2)]


def test_gradients_reach_the_image_and_not_the_weights(tmp_path: Path) -> None:
    net = small_net(tmp_path)
    image = picture(3, 8, 8).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: net(x)[-1].sum(), (image,), eps=1e-6, atol=1e-5, rtol=1e-6)
    assert all(not t.requires_grad for pair in net.convolutions.layers.values() for t in pair)


def test_srgb_is_the_standard_curve_with_a_gradient_everywhere() -> None:
    linear = torch.tensor([-0.1, 0.0, 1e-4, 0.0031308, 0.0032, 0.18, 1.0, 4.0], dtype=torch.float64, requires_grad=True)
    encoded = encode_srgb(linear)
    np.testing.assert_allclose(encoded.detach().numpy(), linear_to_srgb(linear.detach().numpy()), atol=1e-12)
    (slope,) = torch.autograd.grad(encoded.sum(), linear)
    assert slope.isfinite().all() and (slope > 0).all()


def test_torchvision_layers_are_found_in_their_places() -> None:
    # torchvision's VGG-19, "E": convolutions and ReLUs, pooling after blocks of 2, 2, 4, 4 (here with few channels).
    torch.manual_seed(0)
    modules: list[torch.nn.Module] = []
    channels = 3
    for width in (4, 4, 0, 5, 5, 0, 6, 6, 6, 6, 0, 7, 7, 7, 7, 0):
        if width:
            modules += [torch.nn.Conv2d(channels, width, 3, padding=1), torch.nn.ReLU()]
            channels = width
        else:
            modules.append(torch.nn.AvgPool2d(2))
    network = torch.nn.Sequential(*modules).double()
    found = weights_file.torchvision_convolutions({f"features.{k}": v for k, v in network.state_dict().items()})
    assert list(found.layers) == [f"conv{b}_{i}" for b, n in ((1, 2), (2, 2), (3, 4), (4, 1)) for i in range(1, n + 1)]
    from usdfab.fit.features import FeatureNet

    image = picture(4, 16, 16)
    mean, deviation = (
        torch.tensor(v, dtype=torch.float64).view(1, 3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    with torch.no_grad():
        expected = network[:21]((encode_srgb(image) - mean) / deviation)  # up to the ReLU of conv4_1
        np.testing.assert_allclose(FeatureNet(found)(image)[-1], expected, rtol=1e-10, atol=1e-10)


def test_bfloat16_is_close_to_float32() -> None:
    image = picture(5, 64, 64, torch.float32)
    exact, fast = (load_features(dtype=d)(image) for d in (torch.float32, torch.bfloat16))
    for a, b in zip(exact, fast, strict=True):
        assert b.dtype == torch.bfloat16
        assert (a - b.float()).abs().mean() < 0.02 * a.abs().mean()
    assert fast_dtype() in (torch.float32, torch.bfloat16)


def refused(call: object, *words: str) -> None:
    """``call()`` must raise one clear line with all ``words``."""
    with pytest.raises(UsdfabError) as caught:
        call()  # type: ignore[operator]
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in words), text


def test_missing_and_damaged_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = weights_file.SHIPPED.read_bytes()
    copy = tmp_path / "copy.safetensors"
    monkeypatch.setattr(weights_file, "SHIPPED", copy)
    refused(load_features, "missing", "copy.safetensors", "install")
    copy.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    refused(load_features, "checksum", "copy.safetensors")
    copy.write_bytes(data[: len(data) // 2])
    refused(load_features, "checksum")
    copy.write_bytes(data)
    assert load_features().taps


def test_wrong_files_of_a_user(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    refused(lambda: load_features(path), "no such file", "vgg16")
    good = tensors()
    save_file(good, path)
    whole = path.read_bytes()
    for damaged in (b"", whole[:40], whole[:-8], b"PK\x03\x04" + whole):
        path.write_bytes(damaged)
        refused(lambda: load_features(path), "mine.safetensors", "safetensors file")
    changes = {
        "conv1_1 has no bias": {"conv1_1.bias": None},
        "missing before conv1_2": {"conv1_1.weight": None, "conv1_1.bias": None},
        "missing before conv4_1": {"conv4_1.weight": good["conv2_1.weight"], "conv4_1.bias": good["conv2_1.bias"]},
        "conv1_2 has the shapes": {"conv1_2.weight": np.zeros((4, 5, 3, 3))},
        "not finite": {"conv2_1.bias": np.full(6, np.nan)},
        "'fc6.weight' belongs to no": {"fc6.weight": np.zeros(3)},
        "holds no convolution": dict.fromkeys(good),
    }
    for words, change in changes.items():
        save_file({k: v for k, v in (good | change).items() if v is not None}, path)
        refused(lambda: load_features(path), "mine.safetensors", words)


def test_taps_that_are_not_there() -> None:
    refused(lambda: load_features(taps=("conv5_1",)), "conv5_1", "conv4_1")
    refused(lambda: load_features(taps=("conv2_1", "conv1_1")), "conv2_1, conv1_1")
    refused(lambda: load_features(taps=()), "nothing")


def torchvision_state() -> dict[str, np.ndarray]:
    """``tensors`` as torchvision numbers them: convolution, ReLU, convolution, ReLU, pooling, convolution."""
    places = {"conv1_1": 0, "conv1_2": 2, "conv2_1": 5}
    return {f"features.{places[k.split('.')[0]]}.{k.split('.')[1]}": v for k, v in tensors().items()}


def test_a_file_with_torchvisions_keys(tmp_path: Path) -> None:
    path = tmp_path / "vgg.safetensors"
    save_file(torchvision_state() | {"classifier.0.bias": np.zeros(3)}, path)
    net = load_features(path, dtype=torch.float64)
    assert net.taps == ("conv1_1", "conv2_1")
    image = picture(6, 12, 12)
    mean, deviation = (np.array(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    weights = tensors()
    layer = {n: (weights[f"{n}.weight"], weights[f"{n}.bias"]) for n in ("conv1_1", "conv1_2", "conv2_1")}
    first = convolved((linear_to_srgb(image[0].numpy()) - mean) / deviation, *layer["conv1_1"])
    last = convolved(pooled(convolved(first, *layer["conv1_2"]), "average"), *layer["conv2_1"])
    found = net(image)
    np.testing.assert_allclose(found[0][0].numpy(), first, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found[1][0].numpy(), last, rtol=1e-10, atol=1e-10)


def test_torchvisions_keys_of_other_networks(tmp_path: Path) -> None:
    path, good = tmp_path / "vgg.safetensors", torchvision_state()
    gap = {k.replace(".5.", ".6."): v for k, v in good.items()}
    for words, state in {
        "'features.1.running_mean' belongs": good | {"features.1.running_mean": np.zeros(4)},
        "missing before features.6": gap,
        "missing before features.2": {k: v for k, v in good.items() if ".0." not in k},
        "conv2_1 has no bias": {k: v for k, v in good.items() if k != "features.5.bias"},
        "conv1_2 has the shapes": good | {"features.2.weight": np.zeros((4, 5, 3, 3))},
    }.items():
        save_file(state, path)
        refused(lambda: load_features(path), "vgg.safetensors", words)


def test_vgg19_is_never_downloaded_and_pickle_never_read(tmp_path: Path) -> None:
    refused(
        lambda: load_features("vgg19"), "nothing is downloaded", "safetensors.torch import save_file", "torchvision"
    )
    path = tmp_path / "vgg19.pth"
    torch.save({k: torch.from_numpy(v) for k, v in torchvision_state().items()}, path)
    refused(lambda: load_features(path), "vgg19.pth", "no whole safetensors file")


def test_the_conversion_command_is_python_and_writes_such_keys() -> None:
    code = weights_file.CONVERSION.removeprefix('python -c "').removesuffix('"')
    compile(code, "command", "exec")
    # What the command asks of torchvision's `features`, a Sequential.
    keys = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.ReLU()).state_dict(prefix="features.")
    assert sorted(keys) == ["features.0.bias", "features.0.weight"] and "state_dict(prefix='features.')" in code

import os
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from torch.nn import functional as F

from forewarp.metrics import lpips
from forewarp.metrics.limits import NETS
from forewarp.metrics.lpips import LPIPS, find_lpips, find_lpips_weights
from tests.support import reference


def weights_folder():
    root = Path(__file__).parents[2]
    data = Path(os.environ.get("FOREWARP_DATA") or root.parent / "shared" / "data")
    return data.parent / "weights" / "lpips"


@pytest.fixture(scope="module")
def squeeze():
    file = weights_folder() / "squeeze.backbone.pth"
    if not file.exists():
        pytest.skip("no SqueezeNet backbone weights; set FOREWARP_DATA to the folder beside them")
    return LPIPS("squeeze", file)


@pytest.fixture(autouse=True)
def no_weights_of_the_machine(monkeypatch, tmp_path):
    monkeypatch.delenv(lpips.WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))


@pytest.fixture(scope="module")
def alex_file(tmp_path_factory):
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("weights") / "alexnet-owt-0.pth"
    torch.save(lpips.alexnet_features().state_dict(), file)
    return file


def example(name):
    pixels = iio.imread(weights_folder() / "example_images" / f"ex_{name}.png")
    return torch.from_numpy(pixels[..., :3]).float() / 255


def images(height=48, width=56):
    return torch.rand(2, height, width, 3, generator=torch.Generator().manual_seed(3))


def test_published_values_of_random_images(squeeze):
    generator = torch.Generator().manual_seed(42)
    first, second = (torch.rand(2, 3, 100, 100, generator=generator) * 2 - 1 for _ in range(2))
    assert squeeze.distance(first, second).tolist() == pytest.approx([0.10238, 0.09377], abs=1e-5)


@pytest.mark.parametrize(("name", "distance"), [("p0", 0.7110), ("p1", 0.1479), ("ref", 0.0)])
def test_published_values_of_the_example_images(squeeze, name, distance):
    assert squeeze(example(name), example("ref")) == pytest.approx(distance, abs=1e-4)


def test_heads_of_torchmetrics_are_version_0_1(squeeze):
    original = torch.load(weights_folder() / "lin_v0.1/squeeze.pth", "cpu", weights_only=True)
    for k, head in enumerate(lpips.heads_of("squeeze")):
        assert torch.equal(head, original[f"lin{k}.model.1.weight"])
        assert torch.equal(head, squeeze.state_dict()[f"head{k}"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("net", "parameters", "taps"),
    [
        ("squeeze", 722_496, [64, 128, 256, 384, 384, 512, 512]),
        ("vgg", 14_714_688, [64, 128, 256, 512, 512]),
        ("alex", 2_469_696, [64, 192, 384, 256, 256]),
    ],
)
def test_architectures(net, parameters, taps):
    features = lpips._BACKBONES[net]()
    assert sum(p.numel() for p in features.parameters()) == parameters
    x, widths = torch.zeros(1, 3, 64, 80), []
    with torch.no_grad():
        for index, layer in enumerate(features):
            x = layer(x)
            if index in lpips._TAPS[net]:
                widths.append(x.shape[1])
    assert widths == taps == [head.shape[1] for head in lpips.heads_of(net)]


@pytest.mark.slow
def test_is_its_twin(alex_file):
    net = LPIPS("alex", alex_file)
    first, second = images()
    first, second = ((x * 255).round() / 255 for x in (first, second))
    heads = [getattr(net, f"head{k}") for k in range(5)]
    planes = [x.permute(2, 0, 1)[None] * 2 - 1 for x in (first, second)]
    twin = reference.lpips_distance(net.features, lpips._TAPS["alex"], heads, *planes)
    assert net(first, second) == pytest.approx(twin, rel=1e-4)
    assert twin > 1e-3


def test_of_a_mask_both_images_are_black_outside_and_maps_are_averaged_inside(alex_file):
    net, (first, second) = LPIPS("alex", alex_file), images()
    first, second = ((x * 255).round() / 255 for x in (first, second))
    mask = torch.zeros(first.shape[:2], dtype=torch.bool)
    mask[5:30, 9:21] = True
    total, x = 0, torch.stack([(2 * i * mask[..., None] - 1).permute(2, 0, 1) for i in (first, second)])
    x, taps = (x - net.shift) / net.scale, lpips._TAPS["alex"]
    for index, layer in enumerate(net.features):
        x = layer(x)
        if index in taps:
            a, b = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            part = ((a - b).square() * getattr(net, f"head{taps.index(index)}")[0]).sum(0)
            total = total + F.interpolate(part[None, None], mask.shape, mode="bilinear")[0, 0]
    assert net(first, second, mask) == pytest.approx(float(total[mask].mean()), rel=1e-4)
    assert net(torch.where(mask[..., None], first, second), first, mask) == 0
    assert net(first, second, mask & ~mask) is None


def test_equal_and_white_images_are_at_no_distance(alex_file):
    net = LPIPS("alex", alex_file)
    first, second = images()
    white = torch.ones(40, 40, 3)
    assert net(first, first) == net(white, white) == 0
    assert net(first, second) == pytest.approx(net(second, first), rel=1e-5)
    assert net(*images(31, 64)) is None  # too small
    assert net(*images(32, 32)) > 0
    assert not any(p.requires_grad for p in net.parameters())


@pytest.mark.slow
def test_whole_model_files_are_read(alex_file, tmp_path):
    bare = torch.load(alex_file, weights_only=True)
    whole = {f"features.{key}": value for key, value in bare.items()}
    torch.save(whole | {"classifier.1.weight": torch.zeros(2)}, tmp_path / "alexnet-whole.pth")
    pair = images()
    assert LPIPS("alex", tmp_path / "alexnet-whole.pth")(*pair) == LPIPS("alex", alex_file)(*pair)


def test_weights_are_found_in_order(alex_file, tmp_path, monkeypatch):
    def touch(folder, name):
        path = tmp_path / folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        return path

    assert find_lpips() == {"lpips_squeeze": None, "lpips_vgg": None, "lpips_alex": None}
    files = ("squeezenet1_1-b8a52dc0.pth", "vgg16-397923af.pth", "alexnet-owt-7be5be79.pth")
    in_hub = {net: touch("hub/checkpoints", file) for net, file in zip(NETS, files)}
    touch("hub/checkpoints", "vgg16_bn-6c64b313.pth")
    touch("hub/checkpoints", "alex.pth")  # heads are not taken for a backbone
    assert {net: find_lpips_weights(net) for net in NETS} == in_hub
    named = touch("named", "vgg16-1.pth")
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(named.parent))
    assert find_lpips_weights("vgg") == named
    assert find_lpips_weights("alex") == in_hub["alex"]
    assert find_lpips_weights("alex", str(alex_file)) == alex_file
    assert find_lpips_weights("alex", [None, alex_file.parent]) == alex_file
    assert find_lpips_weights("vgg", [alex_file]) == named
    assert find_lpips(["alex"], alex_file)["lpips_alex"].net == "alex"


def test_refusals(alex_file, tmp_path, monkeypatch):
    (tmp_path / "mine.pth").touch()
    for net, place, match in (
        ("resnet", None, "lpips: expected a net of squeeze, vgg, alex, but got 'resnet'"),
        ("vgg", tmp_path / "absent", "lpips_weights: expected an existing .* but got .*absent"),
        ("vgg", tmp_path / "mine.pth", "lpips_weights: expected a file named like .*mine.pth; rename it"),
    ):
        with pytest.raises(ValueError, match=match):
            find_lpips_weights(net, place)
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(ValueError, match="FOREWARP_LPIPS_WEIGHTS: expected an existing"):
        find_lpips_weights("vgg")
    (tmp_path / "text.pth").write_text("not a model")
    for arguments, match in (
        (("squeeze", alex_file), "squeeze's features, but got others: .*size mismatch for 0.weight"),
        (
            ("alex", tmp_path / "mine.pth"),
            "mine.pth: expected weights of alex's features, but got ValueError on reading",
        ),
        (
            ("alex", tmp_path / "text.pth"),
            "text.pth: expected weights of alex's features, but got ValueError on",
        ),
    ):
        with pytest.raises(ValueError, match=match):
            LPIPS(*arguments)

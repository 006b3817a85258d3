//! What a pickle may name, and what may be made by calling it.

use super::value::{Rebuild, Value};
use tch::Kind;

/// What tensors are put together by.
const KNOWN: [(&str, &str, Value); 23] = [
    ("torch._utils", "_rebuild_tensor", Value::Rebuild(Rebuild::View)),
    ("torch._utils", "_rebuild_tensor_v2", Value::Rebuild(Rebuild::View)),
    ("torch._utils", "_rebuild_parameter", Value::Rebuild(Rebuild::Parameter)),
    ("torch._utils", "_rebuild_parameter_with_state", Value::Rebuild(Rebuild::Parameter)),
    ("torch._tensor", "_rebuild_from_type_v2", Value::Rebuild(Rebuild::OfClass)),
    ("collections", "OrderedDict", Value::OrderedDict),
    ("torch", "ByteStorage", Value::Dtype(Kind::Uint8)),
    ("torch", "CharStorage", Value::Dtype(Kind::Int8)),
    ("torch", "ShortStorage", Value::Dtype(Kind::Int16)),
    ("torch", "IntStorage", Value::Dtype(Kind::Int)),
    ("torch", "LongStorage", Value::Dtype(Kind::Int64)),
    ("torch", "HalfStorage", Value::Dtype(Kind::Half)),
    ("torch", "BFloat16Storage", Value::Dtype(Kind::BFloat16)),
    ("torch", "FloatStorage", Value::Dtype(Kind::Float)),
    ("torch", "DoubleStorage", Value::Dtype(Kind::Double)),
    ("torch", "BoolStorage", Value::Dtype(Kind::Bool)),
    ("torch", "ComplexFloatStorage", Value::Dtype(Kind::ComplexFloat)),
    ("torch", "ComplexDoubleStorage", Value::Dtype(Kind::ComplexDouble)),
    ("torch", "QInt8Storage", Value::Dtype(Kind::QInt8)),
    ("torch", "QUInt8Storage", Value::Dtype(Kind::QUInt8)),
    ("torch", "QInt32Storage", Value::Dtype(Kind::QInt32)),
    ("torch", "UntypedStorage", Value::Dtype(Kind::Uint8)),
    ("torch.storage", "UntypedStorage", Value::Dtype(Kind::Uint8)),
];

/// Functions and classes that put data together and do nothing else when Python calls them: what settings, optimizers and the state
/// of a training are made of.
const HARMLESS: [(&str, &[&str]); 19] = [
    ("__builtin__", BUILTINS),
    ("builtins", BUILTINS),
    ("_codecs", &["encode"]),
    ("argparse", &["Namespace"]),
    ("collections", &["Counter", "defaultdict", "deque"]),
    ("copy_reg", &["_reconstructor"]),
    ("copyreg", &["_reconstructor"]),
    ("datetime", &["date", "datetime", "time", "timedelta", "timezone"]),
    ("functools", &["partial"]),
    ("numpy", &["dtype", "ndarray"]),
    ("numpy._core.multiarray", &["_reconstruct", "scalar"]),
    ("numpy._core.numeric", &["_frombuffer"]),
    ("numpy.core.multiarray", &["_reconstruct", "scalar"]),
    ("numpy.core.numeric", &["_frombuffer"]),
    ("pathlib", &["Path", "PosixPath", "PurePosixPath", "PureWindowsPath", "WindowsPath"]),
    ("pathlib._local", &["Path", "PosixPath", "PurePosixPath", "PureWindowsPath", "WindowsPath"]),
    ("torch", &["Size", "device"]),
    ("torch._utils", &["_rebuild_qtensor", "_rebuild_sparse_tensor", "_rebuild_tensor_v3"]),
    ("torch.serialization", &["_get_layout"]),
];
const BUILTINS: &[&str] = &[
    "bool",
    "bytearray",
    "bytes",
    "complex",
    "dict",
    "float",
    "frozenset",
    "int",
    "list",
    "long",
    "object",
    "range",
    "set",
    "slice",
    "str",
    "tuple",
];

/// Packages whose classes, told by their capitals, hold settings and the state of a training.
const LIBRARIES: [&str; 6] =
    ["lightning", "lightning_fabric", "omegaconf", "pytorch_lightning", "torchmetrics", "yacs"];

/// What tensors are put together by, of that name.
pub(super) fn known(module: &str, name: &str) -> Option<Value<'static>> {
    KNOWN.into_iter().find(|(m, n, _)| (*m, *n) == (module, name)).map(|(.., value)| value)
}

/// Whether a call does nothing but put data together.
pub(super) fn makes_data(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    let is_class = name.starts_with(|first: char| first.is_ascii_uppercase()) && !name.contains('.');
    HARMLESS.iter().any(|(m, names)| *m == module && names.contains(&name))
        || (is_class && LIBRARIES.contains(&package))
}

//! Names that a pickle may use, and those that it may call.

use super::value::{Rebuild, Value};
use tch::Kind;

/// Functions and types that tensors are assembled from.
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

/// Functions and classes that only assemble data when Python calls them: the parts of settings, optimizers and training states.
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

/// Packages whose classes, recognized by their initial capital letter, hold settings and training states.
const LIBRARIES: [&str; 6] =
    ["lightning", "lightning_fabric", "omegaconf", "pytorch_lightning", "torchmetrics", "yacs"];

/// Returns the function or type with this name that tensors are assembled from.
pub(super) fn known(module: &str, name: &str) -> Option<Value<'static>> {
    KNOWN.into_iter().find(|(m, n, _)| (*m, *n) == (module, name)).map(|(.., value)| value)
}

/// Returns `true` if a call of this function or class does nothing but assemble data.
pub(super) fn is_plain_constructor(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    let is_class = name.starts_with(|first: char| first.is_ascii_uppercase()) && !name.contains('.');
    HARMLESS.iter().any(|(m, names)| *m == module && names.contains(&name))
        || (is_class && LIBRARIES.contains(&package))
}

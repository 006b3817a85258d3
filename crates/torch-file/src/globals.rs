//! Names that a pickle may use, and those that it may call.

use crate::Dtype;
use crate::value::{Rebuild, Value};

/// Functions and types that tensors are assembled from, beside the classes of storages.
const TENSOR_GLOBALS: [(&str, &str, Value); 8] = [
    ("torch._utils", "_rebuild_tensor", Value::Rebuild(Rebuild::Tensor)),
    ("torch._utils", "_rebuild_tensor_v2", Value::Rebuild(Rebuild::Tensor)),
    ("torch._utils", "_rebuild_parameter", Value::Rebuild(Rebuild::Parameter)),
    ("torch._utils", "_rebuild_parameter_with_state", Value::Rebuild(Rebuild::Parameter)),
    ("torch._tensor", "_rebuild_from_type_v2", Value::Rebuild(Rebuild::FromType)),
    ("collections", "OrderedDict", Value::OrderedDict),
    ("torch", "UntypedStorage", Value::Dtype(Dtype::U8)),
    ("torch.storage", "UntypedStorage", Value::Dtype(Dtype::U8)),
];

/// Functions and classes that only assemble data when Python calls them: the parts of settings, optimizers and training states.
const DATA_CONSTRUCTORS: [(&str, &[&str]); 19] = [
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
const DATA_PACKAGES: [&str; 6] =
    ["lightning", "lightning_fabric", "omegaconf", "pytorch_lightning", "torchmetrics", "yacs"];

/// Returns the function or type with this name that tensors are assembled from.
pub(crate) fn find_tensor_global(module: &str, name: &str) -> Option<Value<'static>> {
    let storage = Dtype::from_storage_class(name).filter(|_| module == "torch").map(Value::Dtype);
    let listed = || TENSOR_GLOBALS.into_iter().find(|(m, n, _)| (*m, *n) == (module, name));
    storage.or_else(|| listed().map(|(.., value)| value))
}

/// Returns `true` if a call of this function or class does nothing but assemble data.
pub(crate) fn is_plain_constructor(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    let is_class = name.starts_with(|first: char| first.is_ascii_uppercase()) && !name.contains('.');
    DATA_CONSTRUCTORS.iter().any(|(m, names)| *m == module && names.contains(&name))
        || (is_class && DATA_PACKAGES.contains(&package))
}

//! A file that torch wrote, from these contents:
//!
//! ```python
//! m = torch.arange(6, dtype=torch.float32).reshape(2, 3) / 4
//! state = collections.OrderedDict(
//!     weight=torch.nn.Parameter(m),
//!     transposed=m.t(),
//!     f16=torch.tensor([1.5, -2, float("inf")], dtype=torch.float16),
//!     bf16=torch.tensor([1.5, -2, 1e30], dtype=torch.bfloat16),
//!     f64=torch.tensor(0.1, dtype=torch.float64),
//!     empty=torch.zeros(0, 3),
//!     i64=torch.tensor([-1, 2]),
//!     bool=torch.tensor([True, False]),
//! )
//! contents = {"state_dict": state, "epoch": 3, "lr": 0.25, "name": "tiny", "resume": None, "large": 1 << 80, "last": True,
//!             "scheduler": {"steps": [1, 2], "shape": (3, 4)}}
//! torch.save(contents, "zip.pt")
//! ```

use globalsplat_torch_file::{Array, Dtype, Id, TorchFile, Value, is_torch_file};
use std::path::Path;

const BYTES: &[u8] = include_bytes!("../files/zip.pt");

fn dict<'v>(value: Option<&'v Value>) -> &'v [(Id, Id)] {
    match value {
        Some(Value::Dict(items)) => items,
        other => panic!("{other:?}"),
    }
}

#[test]
fn files_of_torch_are_read() {
    assert!(is_torch_file(BYTES) && !is_torch_file(b"") && !is_torch_file(b"\x80\x02}."));
    let file = TorchFile::parse(Path::new("zip.pt"), BYTES).unwrap();
    let values = &file.values;
    let root = dict(Some(values.get(values.root)));
    for (key, expected) in [
        ("epoch", Value::Int(3)),
        ("lr", Value::Float(0.25)),
        ("name", Value::Str("tiny")),
        ("resume", Value::None),
        ("large", Value::Object(vec![])),
        ("last", Value::Bool(true)),
    ] {
        assert_eq!(values.find(root, key), Some(&expected), "{key}");
    }
    let scheduler = dict(values.find(root, "scheduler"));
    for (key, expected) in [("steps", [1, 2]), ("shape", [3, 4])] {
        let Some(Value::List(items) | Value::Tuple(items)) = values.find(scheduler, key) else {
            panic!("{key}");
        };
        let numbers: Vec<_> = items.iter().filter_map(|&id| values.get(id).as_int()).collect();
        assert_eq!(numbers, expected, "{key}");
    }

    let state = dict(values.find(root, "state_dict"));
    let array = |key: &str| Array::locate(values, &file.storages, values.find(state, key).unwrap()).unwrap();
    let numbers: [(&str, Dtype, &[usize], &[f32]); 6] = [
        ("weight", Dtype::F32, &[2, 3], &[0., 0.25, 0.5, 0.75, 1., 1.25]),
        ("transposed", Dtype::F32, &[3, 2], &[0., 0.75, 0.25, 1., 0.5, 1.25]),
        ("f16", Dtype::F16, &[3], &[1.5, -2., f32::INFINITY]),
        ("bf16", Dtype::BF16, &[3], &[1.5, -2., f32::from_bits(0x714a_0000)]),
        ("f64", Dtype::F64, &[], &[0.1]),
        ("empty", Dtype::F32, &[0, 3], &[]),
    ];
    for (key, dtype, shape, expected) in numbers {
        let array = array(key);
        assert_eq!((array.dtype, array.shape.as_slice()), (dtype, shape), "{key}");
        assert_eq!(array.is_contiguous(), key != "transposed", "{key}");
        assert_eq!(array.to_f32(BYTES).unwrap(), expected, "{key}");
    }
    let integers = array("i64");
    assert_eq!(integers.dtype, Dtype::I64);
    assert_eq!(BYTES[integers.bytes.clone()], [-1i64, 2].map(i64::to_le_bytes).concat());
    let error = integers.to_f32(BYTES).unwrap_err();
    assert_eq!(error, "has elements of type I64, expected F16, BF16, F32 or F64");
    let booleans = array("bool");
    assert_eq!((booleans.dtype, &BYTES[booleans.bytes]), (Dtype::BOOL, &[1, 0][..]));
    // Views of one storage share their bytes.
    assert_eq!(array("weight").bytes, array("transposed").bytes);
}

/// Truncated files are refused. No flipped bit makes the reader panic, and none changes a tensor unnoticed.
#[test]
fn truncated_and_damaged_files_do_no_harm() {
    for position in 0..BYTES.len() {
        let error = TorchFile::parse(Path::new("zip.pt"), &BYTES[..position]).expect_err("a refusal");
        assert!(error.is_invalid_request() && error.to_string().starts_with("zip.pt"), "{error}");
        let mut flipped = BYTES.to_vec();
        flipped[position] ^= 1 << (position % 8);
        let Ok(file) = TorchFile::parse(Path::new("zip.pt"), &flipped) else { continue };
        for tensor in file.values.iter().filter(|value| matches!(value, Value::Tensor { .. })) {
            let Ok(array) = Array::locate(&file.values, &file.storages, tensor) else { continue };
            let _ = array.to_f32(&flipped);
            assert!(flipped[array.bytes.clone()] == BYTES[array.bytes]);
        }
    }
}

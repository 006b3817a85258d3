//! Pickles and archives that are refused.

use crate::pickles::{archive, int, tensor_of, text};
use globalsplat_torch_file::{Array, TorchFile, Value};
use std::path::Path;

/// Reads an archive of `pickle` and of a tensor of 64 bytes.
fn read(pickle: &[u8]) -> Result<TorchFile<'static>, String> {
    let file = archive(pickle, &[0; 64]).leak();
    TorchFile::parse(Path::new("a.pt"), file).map_err(|error| error.to_string())
}

#[track_caller]
fn assert_refused(pickle: &[u8], for_what: &str) {
    let error = read(pickle).expect_err("a refusal");
    assert!(error.contains(for_what) && error.contains("nothing was run"), "{error:?} lacks {for_what:?}");
}

/// Returns the pickle of a tensor of the storage with a persistent id of these parts.
fn pickle_of(id: &[Vec<u8>], offset: u32, size: &[u32], stride: &[u32]) -> Vec<u8> {
    [b"\x80\x02", &tensor_of(id, offset, size, stride)[..], b"."].concat()
}

fn float() -> Vec<u8> {
    b"ctorch\nFloatStorage\n".to_vec()
}

#[test]
fn functions_are_not_called() {
    for (pickle, calls) in [
        (b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R.".as_slice(), "calls os.system"),
        (b"\x80\x04\x8c\x05posix\x8c\x06system\x93)R.", "calls posix.system"),
        (b"\x80\x02c__builtin__\neval\nX\x01\x00\x00\x001\x85R.", "calls __builtin__.eval"),
        // The attribute of a class that only holds settings.
        (b"\x80\x02comegaconf\nA.b\n)R.", "calls omegaconf.A.b"),
        (b"\x80\x02ctorch\nFloatStorage\nK\x04\x85R.", "calls torch.FloatStorage"),
        // A function that rebuilds a tensor calls its first argument.
        (b"\x80\x02ctorch._tensor\n_rebuild_from_type_v2\n(cos\nsystem\nN)tR.", "calls os.system"),
    ] {
        assert_refused(pickle, calls);
    }
}

/// Settings beside the tensors don't make a checkpoint unreadable.
#[test]
fn data_of_unknown_classes_are_kept() {
    for pickle in [
        b"\x80\x02cargparse\nNamespace\n)\x81}b.".as_slice(),
        b"\x80\x02cpathlib\nPosixPath\nX\x01\x00\x00\x00/\x85R.",
        b"\x80\x02comegaconf.dictconfig\nDictConfig\n)R}b.",
        b"\x80\x02canything\nAtAll\n)\x81}b.",
    ] {
        let values = read(pickle).unwrap().values;
        assert_eq!(values.get(values.root), &Value::Object(vec![]));
    }
}

#[test]
fn unsound_pickles_are_refused() {
    for (pickle, message) in [
        (b"\x80\x02]r\xff\xff\xff\xff.".as_slice(), "memo 4294967295"),
        (b"\x80\x02h\x00.", "recalls memo 0, which is missing"),
        (b"\x80\x02}K\x01a.", "appends to a dict"),
        (b"\x80\x02](X\x01\x00\x00\x00aNu.", "sets items of a list"),
        (b"\x80\x02}(X\x01\x00\x00\x00au.", "a key without a value"),
        (b"\x80\x02a.", "pops from an empty stack"),
        (b"\x80\x02K\x01(0.", "pops from an empty stack"),
        (b"\x80\x02t.", "without a mark"),
        (b"\x80\x02K\x01K\x02.", "ends with 2 values"),
        (b"\x80\x02X\xff\xff\xff\x7fabc.", "cut off"),
        (b"\x80\x02X\x01\x00\x00\x00\xff.", "a string that is no UTF-8"),
        (b"\x80\x06N.", "protocol 6"),
        (b"\x80\x02I1\n.", "instruction 0x49, which no tensors need"),
        (b"\x80\x04K\x01K\x02\x93.", "a name that is no string"),
        (b"\x80\x02)K\x01\x81.", "an instance of a tuple"),
        (b"\x80\x02K\x01)R.", "calls an integer"),
    ] {
        assert_refused(pickle, message);
    }
}

#[test]
fn values_may_contain_themselves() {
    for pickle in [b"\x80\x02]q\x00h\x00a.".as_slice(), b"\x80\x02]q\x00(h\x00e."] {
        let values = read(pickle).unwrap().values;
        assert_eq!(values.get(values.root), &Value::List(vec![values.root]));
    }
    // Deep nesting uses no stack.
    let nested = [b"\x80\x02".to_vec(), b"]".repeat(100_000), b"a".repeat(99_999), b".".to_vec()].concat();
    assert_eq!(read(&nested).unwrap().values.iter().count(), 100_000);
}

#[test]
fn only_storages_are_storages() {
    for id in [
        // A number instead of the storage's type, which libtorch would use as an address.
        vec![text("storage"), int(u32::MAX), text("0"), text("cpu"), int(64)],
        vec![text("module"), float(), text("0"), text("cpu"), int(64)],
        vec![text("storage"), float(), int(0), text("cpu"), int(64)],
        vec![text("storage"), float(), text("0"), int(0), int(64)],
        vec![text("storage"), float(), text("0"), text("cpu"), text("64")],
        vec![text("storage"), float(), text("0"), text("cpu")],
        vec![],
    ] {
        assert_refused(&pickle_of(&id, 0, &[1], &[1]), "a persistent id that is no storage");
    }
    for arguments in [b"".as_slice(), b"NK\x00))\x89)", b"K\x00K\x00))\x89)"] {
        let pickle = [b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(", arguments, b"tR."].concat();
        assert_refused(&pickle, "a tensor of other than storage");
    }
}

#[test]
fn tensors_stay_inside_their_storages() {
    let locate = |key: &str, offset: u32, size: &[u32], stride: &[u32]| {
        let id = [text("storage"), float(), text(key), text("cpu"), int(64)];
        let values = read(&pickle_of(&id, offset, size, stride)).unwrap().values;
        let storages = [("0".to_string(), 100..164)].into();
        Array::locate(&values, &storages, values.get(values.root))
    };
    assert_eq!(locate("0", 2, &[3, 2], &[4, 1]).unwrap().bytes, 108..148);
    assert_eq!(locate("0", 0, &[16], &[1]).unwrap().bytes, 100..164);
    for (key, offset, size, stride, found) in [
        ("1", 0, [1].as_slice(), [1].as_slice(), "asks for data/1, which is missing"),
        ("0", 0, &[17], &[1], "reaches beyond its data of 64 bytes"),
        ("0", 15, &[2], &[1], "reaches beyond its data of 64 bytes"),
        ("0", 1 << 30, &[2], &[1], "reaches beyond its data of 64 bytes"),
        ("0", 0, &[i32::MAX as u32; 3], &[i32::MAX as u32; 3], "reaches beyond its data of 64 bytes"),
        // Negative numbers.
        ("0", u32::MAX, &[2], &[1], "is no plain tensor"),
        ("0", 0, &[u32::MAX], &[1], "is no plain tensor"),
        ("0", 0, &[2], &[1, 1], "is no plain tensor"),
        ("0", 0, &[1; 9], &[1; 9], "is no plain tensor"),
        // A stride of 0 gives more elements than the storage has bytes, and a copy would have to store them all.
        ("0", 0, &[1 << 30], &[0], "is no plain tensor"),
    ] {
        assert_eq!(locate(key, offset, size, stride).unwrap_err(), found, "{offset} {size:?} {stride:?}");
    }
}

#[test]
fn archives_that_inflate_are_refused() {
    let refusal = |bytes: &[u8]| {
        let error = TorchFile::parse(Path::new("a.pt"), bytes).expect_err("a refusal");
        assert!(error.is_invalid_request(), "{error}");
        error.to_string()
    };
    let whole = archive(b"\x80\x02}.", &[7; 64]);
    let data = whole.windows(64).position(|window| window == [7; 64]).unwrap();
    // The entry of the tensor in the central directory.
    let entry = whole.windows(4).rposition(|window| window == b"PK\x01\x02").unwrap();
    for (at, changed, message) in [
        // Deflated, with another size after decompression.
        (entry + 10, &[8][..], "archive/data/0 is compressed"),
        (entry + 24, &[1], "archive/data/0 is compressed"),
        (entry + 20, &[0xff, 0xff, 0xff, 0xf0, 0xff, 0xff, 0xff, 0xf0], "expected inside the file"),
        // At the offset of the pickle: entries that share bytes could make the reader compute many checksums.
        (entry + 42, &[0; 4], "in one place with another entry"),
        (data, &[8], "archive/data/0 is damaged: its checksum differs"),
    ] {
        let mut bytes = whole.clone();
        bytes[at..][..changed.len()].copy_from_slice(changed);
        let error = refusal(&bytes);
        assert!(error.contains(message), "{error}");
    }
    assert!(refusal(&whole[..whole.len() - 30]).contains("no whole zip archive"));
}

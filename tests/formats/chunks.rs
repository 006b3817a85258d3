//! Chunks: writing, reading back, and invalid files.

#[path = "../../crates/torch-file/tests/torch_files/pickles.rs"]
mod pickles;

use crate::common::formats::{HEIGHT, WIDTH, assert_same_cameras, cameras, names, transforms};
use crate::common::program::{Sandbox, assert_says, number, refuse};
use crate::common::room::write_room;
use globalsplat::data::{Chunk, ChunkWriter, Dataset, Split, open_capture};
use image::RgbImage;
use pickles::{archive, int, tensor_of, text};
use std::io::Cursor;
use std::path::{Path, PathBuf};

const SCENES: [&str; 3] = ["room_0", "room_1", "room_2"];

/// Writes three small captures to `folder`, packs them into chunks of two scenes and of one in `folder/chunks`, and returns
/// that folder.
fn packed(folder: &Path) -> PathBuf {
    let chunks = folder.join("chunks");
    std::fs::create_dir(&chunks).unwrap();
    let mut bytes = 0;
    for (seed, name) in SCENES.iter().enumerate() {
        write_room(&folder.join(name), seed as u64, 3, [24, 32].into());
        if seed < 2 {
            let images = std::fs::read_dir(folder.join(name).join("images")).unwrap();
            bytes += images.map(|image| image.unwrap().metadata().unwrap().len() as usize).sum::<usize>();
        }
    }
    let mut writer = ChunkWriter::new(&chunks, bytes).unwrap();
    for name in SCENES {
        writer.add(&open_capture(&folder.join(name)).unwrap()).unwrap();
    }
    assert_eq!(writer.finish().unwrap(), 2);
    chunks
}

#[test]
fn packed_captures_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let chunks = packed(folder.path());
    let dataset = Dataset::open(&chunks, Split::Test).unwrap();
    assert_eq!((dataset.scenes(), dataset.groups.len()), (3, 2));
    for group in &dataset.groups {
        let open = group.open().unwrap();
        for key in &group.keys {
            let (found, expected) =
                (open.capture(key).unwrap(), open_capture(&folder.path().join(key)).unwrap());
            assert_eq!(&found.name, key);
            // The values of a chunk are float32.
            let cameras: Vec<_> = expected.cameras();
            for (a, b) in found.cameras().iter().zip(&cameras) {
                assert!(a.c2w.abs_diff_eq(b.c2w, 1e-6));
                let (k, l) = (a.intrinsics.to_rows(), b.intrinsics.to_rows());
                assert!(k.iter().zip(l).all(|(a, b)| (a - b).abs() < 1e-4), "{k:?} {l:?}");
            }
            for (a, b) in found.load_all(None).unwrap().iter().zip(expected.load_all(None).unwrap()) {
                assert_eq!(a.image, b.image);
            }
        }
    }
    let one =
        open_capture(&PathBuf::from(format!("{}#room_1", chunks.join("000000.torch").display()))).unwrap();
    assert_eq!(one.names().collect::<Vec<_>>(), ["000000", "000001", "000002"]);
    let alone = open_capture(&chunks.join("000001.torch")).unwrap();
    assert_same_cameras(&alone, &dataset.groups[1].open().unwrap().capture("room_2").unwrap().cameras());
    let root = folder.path().join("set");
    std::fs::create_dir(&root).unwrap();
    std::fs::rename(&chunks, root.join("test")).unwrap();
    let dataset = Dataset::open(&root, Split::Test).unwrap();
    assert_eq!((dataset.name.as_str(), dataset.scenes()), ("set", 3));
}

#[test]
fn split_folders_contain_only_their_own_captures() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("set");
    let write = |name: &str| write_room(&root.join(name), 0, 3, [24, 24].into());
    let scenes = |split: Split| -> Vec<String> {
        let dataset = Dataset::open(&root, split).unwrap();
        dataset.groups.iter().flat_map(|group| group.keys.clone()).collect()
    };
    write("test/seen_never");
    let error = Dataset::open(&root, Split::Train).unwrap_err().to_string();
    assert!(error.contains("a folder whose captures are all in") && error.contains("test"), "{error}");
    write("a");
    write("more/b");
    assert_eq!(scenes(Split::Train), ["a", "b"]);
    assert_eq!(scenes(Split::Test), ["seen_never"]);
    std::fs::rename(root.join("test"), root.join("train")).unwrap();
    assert_eq!(scenes(Split::Test), ["a", "b"]);
    assert_eq!(scenes(Split::Train), ["seen_never"]);
}

#[test]
fn pack_and_inspect_report_their_results() {
    let sandbox = Sandbox::empty();
    write_room(&sandbox.path("room"), 1, 3, [24, 24].into());
    let report = sandbox.json("pack @room --out @out");
    assert_eq!(["/scenes", "/views", "/chunks"].map(|key| number(&report, key)), [1., 3., 1.]);
    for (path, kind, field, count) in
        [("out/000000.torch", "chunk", "/views/room", 3.), ("out", "data set", "/scenes", 1.)]
    {
        let report = sandbox.json(&format!("inspect @{path}"));
        assert_eq!((report["kind"].as_str(), number(&report, field)), (Some(kind), count));
    }
    let error = sandbox.refuse("pack @room --out @out");
    assert_says(&error, &["a folder that already contains chunks"]);
    let error = sandbox.refuse("pack @room @room --out @twice");
    assert_says(&error, &["which is already in 000000.torch"]);
}

/// Asserts that a chunk with these bytes is refused, in a message that contains `for_what`.
#[track_caller]
fn assert_refused(bytes: Vec<u8>, for_what: &str) {
    let error = Chunk::parse(Path::new("chunk.torch"), bytes).expect_err("a refusal");
    assert!(error.is_invalid_request(), "{error}");
    assert!(error.to_string().contains(for_what), "{error} lacks {for_what:?}");
}

/// Returns a key of a dict and its value.
fn entry(key: &str, value: &[u8]) -> Vec<u8> {
    [&text(key), value].concat()
}

/// Returns a pickled tensor of `size` with `stride` at `offset` of a storage that claims to have 64 elements, and was saved on a GPU.
fn tensor(storage: &str, offset: u32, size: &[u32], stride: &[u32]) -> Vec<u8> {
    let id =
        [text("storage"), format!("ctorch\n{storage}\n").into_bytes(), text("0"), text("cuda:0"), int(64)];
    tensor_of(&id, offset, size, stride)
}

/// Returns the pickle of a list of one scene with `entries`, of which `images` lists the tensors.
fn scene(entries: &[(&str, &[u8])], images: &[u8]) -> Vec<u8> {
    let entries: Vec<u8> = entries.iter().flat_map(|(key, value)| entry(key, value)).collect();
    let images = entry("images", &[b"](", images, b"e"].concat());
    [b"\x80\x02](}(".as_slice(), &entries, &images, b"ue."].concat()
}

/// Returns the pickle of a scene with one view, its fields given.
fn one_view(cameras: &[u8], image: &[u8]) -> Vec<u8> {
    let timestamps = tensor("LongStorage", 0, &[1], &[1]);
    scene(
        &[("key", &text("a")), ("url", &text("")), ("cameras", cameras), ("timestamps", &timestamps)],
        image,
    )
}

fn good_cameras() -> Vec<u8> {
    tensor("FloatStorage", 0, &[1, 18], &[18, 1])
}

#[test]
fn pickles_of_other_values_are_refused() {
    let cases: [(&[u8], &str); 5] = [
        // A list that contains itself.
        (b"\x80\x02]q\x00h\x00a.", "scene 0 is a list, expected a dict"),
        (b"\x80\x02}(K\x01K\x02u.", "a dict, expected a list of scenes"),
        (b"\x80\x02K\x01.", "an integer, expected a list of scenes"),
        (b"\x80\x02](K\x01e.", "scene 0 is an integer, expected a dict"),
        (b"\x80\x02](}e.", "scene 0 has no images"),
    ];
    for (pickle, for_what) in cases {
        assert_refused(archive(pickle, &[0; 64]), for_what);
    }
}

#[test]
fn repeated_references_are_limited_by_size() {
    // One image and one scene, each referenced many times by two bytes.
    for (views, scenes, fits) in [(50, 50, true), (2000, 50, true), (2000, 2000, false)] {
        let image = [tensor("ByteStorage", 0, &[4], &[1]), b"q\x01".to_vec(), b"h\x01".repeat(views - 1)];
        let cameras = tensor("FloatStorage", 0, &[views as u32, 18], &[18, 1]);
        let one = scene(&[("key", &text("a")), ("cameras", &cameras)], &image.concat());
        // The scene is the first of the list, and remembered for the others.
        let (start, rest) = one.strip_suffix(b"e.").unwrap().split_at(b"\x80\x02](}".len());
        let program = [start, b"q\x00", rest, &b"h\x00".repeat(scenes - 1), b"e."].concat();
        let bytes = archive(&program, &vec![0; 72 * views]);
        match Chunk::parse(Path::new("c.torch"), bytes) {
            Ok(chunk) => assert!(fits && chunk.keys().count() == scenes),
            Err(error) => assert!(!fits && error.to_string().contains("has no room"), "{error}"),
        }
    }
}

#[test]
fn tensors_stay_inside_their_data() {
    let image = |offset, size, stride| tensor("ByteStorage", offset, &[size], &[stride]);
    // The data has 64 bytes, too few for 18 floats, whatever the pickle says about the storage.
    let few = archive(&one_view(&good_cameras(), &image(0, 4, 1)), &[0; 64]);
    assert_refused(few, "cameras of scene 0 reaches beyond its data of 64 bytes");
    let double = tensor("DoubleStorage", 0, &[1, 8], &[8, 1]);
    assert_refused(archive(&one_view(&double, &image(0, 4, 1)), &[0; 64]), "expected floats [1, 18]");
    let whole = |image: &[u8]| archive(&one_view(&good_cameras(), image), &[0; 72]);
    for (image, found) in [
        (image(0, 73, 1), "images of scene 0 reaches beyond its data of 72 bytes"),
        (image(0, 8, 2), "an image of scene 0 is U8 [8], expected the contiguous bytes of a JPEG"),
        (tensor("FloatStorage", 0, &[4], &[1]), "expected the contiguous bytes of a JPEG"),
        (text("x"), "images of scene 0 has a string, expected a tensor"),
    ] {
        assert_refused(whole(&image), found);
    }
    // A tensor of exactly the data's size is accepted here, and then isn't a valid image.
    let chunk = Chunk::parse(Path::new("chunk.torch"), whole(&image(0, 72, 1))).unwrap();
    assert_eq!(chunk.keys().collect::<Vec<_>>(), ["a"]);
    let error = chunk.capture("a").unwrap_err().to_string();
    assert!(error.contains("chunk.torch#a: every image is undecodable"), "{error}");
}

#[test]
fn corruption_is_detected() {
    let folder = tempfile::tempdir().unwrap();
    let file = packed(folder.path()).join("000001.torch");
    let bytes = std::fs::read(&file).unwrap();
    // Any flipped bit in a chunk: the reader must not crash, and images must not change unnoticed.
    let image = bytes.windows(4).position(|window| window == b"\x89PNG").unwrap();
    for position in (0..bytes.len()).step_by(31).chain(image..image + 64) {
        let mut flipped = bytes.clone();
        flipped[position] ^= 1 << (position % 8);
        let read = Chunk::parse(Path::new("chunk.torch"), flipped);
        if (image..image + 64).contains(&position) {
            assert!(read.unwrap_err().to_string().contains("its checksum differs"));
        }
    }
}

#[test]
fn what_is_wrong_with_a_scene_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let chunks = packed(folder.path());
    let chunk = chunks.join("000000.torch");
    let named = format!("{}#room_9", chunk.display());
    let error = refuse(&["inspect", &named]);
    let expected = "the scene is \"room_9\", which is missing, expected one of its 2: room_0, room_1";
    assert!(error.contains(expected), "{error}");
    let error = open_capture(&chunk).unwrap_err().to_string();
    assert!(error.contains("it holds 2 scenes, expected") && error.contains("#KEY"), "{error}");

    std::fs::write(&chunk, archive(b"\x80\x02].", &[])).unwrap();
    let error = open_capture(&chunk).unwrap_err().to_string();
    assert!(error.contains("the list of scenes is empty, expected one scene at least"), "{error}");

    // 18 float32 of a camera and an image.
    let png = std::fs::read(folder.path().join("room_0/images/000.png")).unwrap();
    let program = one_view(&good_cameras(), &tensor("ByteStorage", 72, &[png.len() as u32], &[1]));
    let one = Chunk::parse(Path::new("c.torch"), archive(&program, &[vec![0; 72], png].concat())).unwrap();
    let error = one.capture("a").unwrap_err().to_string();
    assert!(error.contains("c.torch#a: the number of views is 1, expected two or more"), "{error}");

    std::fs::remove_file(&chunk).unwrap();
    let dataset = Dataset::open(&chunks, Split::Train).unwrap();
    let error = dataset.groups[0].open().unwrap_err().to_string();
    assert!(error.contains("000000.torch can't be read"), "{error}");
    for (index, found) in [
        ("[]", "unusable"),
        ("{\"a\": \"../b.torch\"}", "the chunk of a is ../b.torch"),
        ("{\"a\": 3}", "unusable"),
    ] {
        std::fs::write(chunks.join("index.json"), index).unwrap();
        let error = Dataset::open(&chunks, Split::Train).unwrap_err().to_string();
        assert!(error.contains("index.json") && error.contains(found), "{error}");
    }
}

#[test]
fn cameras_images_and_a_key_are_all_that_a_scene_needs() {
    let camera = |x: f32| [0.5, 0.6, 0.5, 0.5, 0., 0., 1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0.];
    // Every other row of a larger tensor, and one photo for both of them.
    let numbers = [camera(0.), camera(9.), camera(2.)].map(|row| row.map(f32::to_le_bytes).concat()).concat();
    let cameras = tensor("FloatStorage", 0, &[2, 18], &[36, 1]);
    let mut png = Cursor::new(vec![]);
    RgbImage::new(16, 16).write_to(&mut png, image::ImageFormat::Png).unwrap();
    let png = png.into_inner();
    let image = tensor("ByteStorage", numbers.len() as u32, &[png.len() as u32], &[1]);
    let pickle = scene(&[("cameras", &cameras), ("key", &text("a#b"))], &image.repeat(2));
    let chunk = Chunk::parse(Path::new("c.torch"), archive(&pickle, &[numbers, png].concat())).unwrap();
    let poses = chunk.capture("a#b").unwrap().cameras();
    assert_eq!(poses.len(), 2);
    assert!((poses[1].c2w.w_axis.x + 2.).abs() < 1e-9 && (poses[1].intrinsics.fy - 9.6).abs() < 1e-6);
}

#[test]
fn a_scene_is_opened_whatever_signs_its_key_has() {
    let sandbox = Sandbox::empty();
    let names = ["#", "x#y", "x.torch#y", "x#y.png"];
    for name in names {
        write_room(&sandbox.path("a#b.torch#c").join(name), 1, 3, [24, 24].into());
    }
    sandbox.run("pack '@a#b.torch#c' --out '@a#b.torch#c/chunks'");
    for name in names {
        let scene = format!("a#b.torch#c/chunks/000000.torch#{name}");
        assert_eq!(open_capture(&sandbox.path(&scene)).unwrap().name, name);
        let report = sandbox.json(&format!("inspect '@{scene}'"));
        assert_eq!((report["kind"].as_str(), report["name"].as_str()), (Some("capture"), Some(name)));
    }
}

/// NeRF's synthetic captures hold the photos of each split in a folder of that name: such a folder is one capture, not a dataset with
/// splits.
#[test]
fn a_capture_with_splits_is_one_scene_of_a_dataset() {
    let folder = tempfile::tempdir().unwrap();
    for split in ["train", "test"] {
        let photos: Vec<String> = names().iter().map(|name| format!("{split}/{name}")).collect();
        std::fs::create_dir(folder.path().join(split)).unwrap();
        for photo in &photos {
            RgbImage::new(WIDTH, HEIGHT).save(folder.path().join(photo)).unwrap();
        }
        let file = folder.path().join(format!("transforms_{split}.json"));
        std::fs::write(file, transforms(&photos, &cameras()).to_string()).unwrap();
    }
    assert_eq!(Dataset::open(folder.path(), Split::Train).unwrap().scenes(), 1);
}

//! The verdict on a capture: what it says of right and of wrong poses, and the page that shows why.

use crate::common::program::{Sandbox, assert_says};
use glam::DMat4;
use serde_json::{Value, json};

/// Returns a capture with exact poses, `@synth/0_000000`.
fn exact() -> Sandbox {
    let sandbox = Sandbox::empty();
    sandbox.run("synth --scenes 1 --frames 12 --off-path 1 --size 128 --out @synth");
    sandbox
}

/// Turns the poses of the second half of the photos by `degrees` about the world's y axis.
fn turn_half(sandbox: &Sandbox, degrees: f64) {
    let turn = DMat4::from_rotation_y(degrees.to_radians());
    sandbox.change_json("synth/0_000000/transforms_train.json", |json| {
        for frame in json["frames"].as_array_mut().unwrap().iter_mut().skip(6) {
            let rows: [[f64; 4]; 4] = serde_json::from_value(frame["transform_matrix"].take()).unwrap();
            let turned = turn * DMat4::from_cols_array_2d(&rows).transpose();
            frame["transform_matrix"] = json!(turned.transpose().to_cols_array_2d());
        }
    });
}

#[test]
fn right_poses_are_good_and_wrong_ones_will_fail() {
    let sandbox = exact();
    let good = sandbox.json("capture @synth/0_000000 --report @good.html");
    assert_eq!((&good["verdict"], &good["quality"]["reasons"]), (&json!("good"), &json!([])), "{good}");
    assert_eq!(good["quality"]["photos"].as_array().map(Vec::len), Some(13));
    let page = sandbox.text("good.html");
    assert!(page.contains("<h1 class=\"good\">good</h1>") && page.contains("<polygon class=\"camera\""));
    assert!(!page.contains("src=\"http") && !page.contains("doubtful photos"));

    turn_half(&sandbox, 10.);
    let bad = sandbox.json("capture @synth/0_000000 --report @bad.html");
    assert_eq!(bad["verdict"], "will_fail", "{bad}");
    let groups: Vec<Value> = serde_json::from_value(bad["quality"]["groups"].clone()).unwrap();
    assert!(groups.len() >= 2, "{bad}");
    let page = sandbox.text("bad.html");
    assert!(page.contains("<h1 class=\"fails\">will fail</h1>") && page.contains("poses are wrong"));
    let refine = "refine --scene @synth/0_000000 --gaussians 500 --steps 20 --out @bad.ply";
    assert_says(&sandbox.fail(refine, 1), &["0_000000: will fail: poses are wrong", "--ignore-verdict"]);
    assert!(!sandbox.path("bad.ply").exists());
    let (_, messages) = sandbox.succeed_with_messages(&format!("{refine} --ignore-verdict"));
    assert_says(&messages, &["0_000000: will fail: poses are wrong"]);
}

#[test]
fn photos_without_poses_need_a_folder_for_the_capture() {
    let sandbox = exact();
    let refused = sandbox.refuse("capture @synth/0_000000/train --report @page.html");
    assert_says(&refused, &["the capture is of no known format", "--out DIR"]);
    assert!(!sandbox.path("page.html").exists());
    let refused = sandbox.refuse("capture @synth/0_000000 --report @synth/0_000000/transforms_train.json");
    assert_says(&refused, &["transforms_train.json"]);
}

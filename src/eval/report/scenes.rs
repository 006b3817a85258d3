//! Scores scene by scene, worst first: comparison images of the worst scenes, and the scores of all.

use super::entries::{Entry, absent, count, dataset_name, decimal, swatch, thousands};
use super::tables::{Head, PSNR, SSIM, cell, table};
use crate::error::{Error, Result};
use crate::eval::evaluation::{SceneScores, comparison_path};
use crate::io::read_image_size;
use crate::metrics::{CaptureScores, ViewScore};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use maud::{Markup, html};
use std::collections::BTreeMap;

/// Maximum number of comparison images on the page: they are most of its bytes.
const PICTURES: usize = 60;
/// Maximum number of views of one scene whose scores are listed.
const LISTED_VIEWS: usize = 12;
const PARTS: [&str; 4] = ["Photo", "Render", "Error", "Depth"];

/// A scene, with every evaluation that scored it.
struct Scene<'a> {
    name: &'a str,
    dataset: &'a str,
    scored: Vec<(&'a Entry<'a>, &'a SceneScores)>,
}

impl Scene<'_> {
    fn worst(&self) -> f64 {
        self.scored.iter().map(|(_, scene)| scene.scores.mean.psnr).fold(f64::INFINITY, f64::min)
    }
}

/// Returns all scenes, the worst first. Evaluations of the same dataset share their scenes, so that images of one scene are next to each
/// other.
fn worst_first<'a>(entries: &'a [Entry<'a>]) -> Vec<Scene<'a>> {
    let mut scenes: BTreeMap<(&str, &str), Vec<_>> = BTreeMap::new();
    for entry in entries {
        for scene in &entry.evaluation.scenes {
            let key = (entry.dataset.as_str(), scene.scores.scene.as_str());
            scenes.entry(key).or_default().push((entry, scene));
        }
    }
    let mut scenes: Vec<Scene> =
        scenes.into_iter().map(|((dataset, name), scored)| Scene { name, dataset, scored }).collect();
    scenes.sort_by(|a, b| a.worst().total_cmp(&b.worst()));
    scenes
}

/// Renders cards with comparison images for the worst scenes, and a table for the others.
pub fn scenes(entries: &[Entry]) -> Result<Markup> {
    let scenes = worst_first(entries);
    let mut pictures = 0;
    let shown = scenes
        .iter()
        .take_while(|scene| {
            pictures += scene.scored.len();
            pictures <= PICTURES
        })
        .count();
    let (shown, others) = scenes.split_at(shown);
    let cards = shown.iter().map(|scene| card(scene, entries.len() > 1)).collect::<Result<Vec<_>>>()?;
    Ok(html! {
        section.scenes {
            h2 { "Scenes, worst first" }
            p { "Each picture shows the view with the lowest PSNR: photo, render, error and depth." }
            @for card in &cards { (card) }
            @if !others.is_empty() { (rest(others)) }
        }
    })
}

fn card(scene: &Scene, compares: bool) -> Result<Markup> {
    let parts = scene.scored.iter().map(|&(entry, scores)| scored(entry, scores, compares));
    let parts = parts.collect::<Result<Vec<_>>>()?;
    Ok(html! {
        article.scene {
            h3 { (scene.name) @if compares { " " span.fine { (dataset_name(scene.dataset)) } } }
            @for part in &parts { (part) }
        }
    })
}

/// Renders one scene of one evaluation.
fn scored(entry: &Entry, scene: &SceneScores, compares: bool) -> Result<Markup> {
    Ok(html! {
        div.scored {
            p.scores {
                @if compares {
                    span.who { (swatch(entry.color)) (entry.name) ", " (count(scene.context.len(), "context view")) }
                }
                (measures(&scene.scores))
                @if let Some(seconds) = scene.forward_seconds { span { "time " b { (decimal(seconds, 2)) } " s" } }
            }
            (comparison(entry, &scene.scores)?)
            dl.frames {
                dt { "Views" }
                dd { (views(&scene.scores.views)) }
                dt { "Context frames" }
                dd { (frames(&scene.context)) }
                dt { "Target frames" }
                dd { (frames(&scene.target)) }
            }
        }
    })
}

fn measures(scores: &CaptureScores) -> Markup {
    html! {
        span { "PSNR " b { (decimal(scores.mean.psnr, 2)) } " dB" }
        span { "SSIM " b { (decimal(scores.mean.ssim, 4)) } }
        span { "LPIPS-VGG " @match scores.mean.lpips_vgg { Some(v) => { b { (decimal(v, 4)) } } None => (absent()) } }
        @if let Some(v) = scores.mean.lpips_alex { span { "LPIPS-Alex " b { (decimal(v, 4)) } } }
        @if let Some(n) = scores.gaussians { span { b { (thousands(n.unsigned_abs())) } " Gaussians" } }
    }
}

/// Renders the comparison image, embedded in the page.
fn comparison(entry: &Entry, scores: &CaptureScores) -> Result<Markup> {
    let path = comparison_path(entry.folder, &scores.scene);
    if !path.is_file() {
        return Ok(html! { p.missing { "No picture: the evaluation's folder has none of this scene." } });
    }
    let (width, height) = read_image_size(&path)?;
    let bytes = std::fs::read(&path).map_err(Error::read(&path))?;
    let source = format!("data:image/jpeg;base64,{}", BASE64_STANDARD.encode(bytes));
    let worst = scores.views.iter().min_by(|a, b| a.scores.psnr.total_cmp(&b.scores.psnr));
    let view = worst.map_or(String::new(), |view| format!(", view {}", view.image));
    let alt =
        format!("{}{view}, by {}: photo, render, error and depth side by side", scores.scene, entry.name);
    Ok(html! {
        div.scroll.comparison-image tabindex="0" role="region" aria-label={ "Images of " (scores.scene) } {
            figure {
                div.parts aria-hidden="true" { @for part in PARTS { span { (part) } } }
                img src=(source) width=(width) height=(height) alt=(alt) decoding="async";
            }
        }
    })
}

/// Renders the scores of the views, worst first. The worst view is the one that the comparison image shows.
fn views(views: &[ViewScore]) -> Markup {
    let mut views: Vec<&ViewScore> = views.iter().collect();
    views.sort_by(|a, b| a.scores.psnr.total_cmp(&b.scores.psnr));
    html! {
        @for (i, view) in views.iter().take(LISTED_VIEWS).enumerate() {
            @if i > 0 { ", " }
            (view.image) " " span.nowrap { (decimal(view.scores.psnr, 2)) " dB" } @if i == 0 { " (shown)" }
        }
        @if views.len() > LISTED_VIEWS { " and " (count(views.len() - LISTED_VIEWS, "better one")) }
    }
}

fn frames(frames: &[usize]) -> String {
    frames.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
}

fn rest(scenes: &[Scene]) -> Markup {
    let head = [
        Head::Text("Scene"),
        Head::Text("Method"),
        Head::Text("Setting"),
        PSNR,
        SSIM,
        Head::Number("LPIPS-VGG\u{a0}↓"),
        Head::Number("LPIPS-Alex\u{a0}↓"),
        Head::Number("Gaussians"),
        Head::Text("Target frames"),
    ];
    let body = html! {
        @for scene in scenes {
            @for (entry, scored) in &scene.scored {
                @let scores = &scored.scores;
                tr {
                    th scope="row" { (scene.name) }
                    td { (swatch(entry.color)) (entry.name) }
                    td { (entry.setting()) }
                    (cell(Some(decimal(scores.mean.psnr, 2))))
                    (cell(Some(decimal(scores.mean.ssim, 4))))
                    (cell(scores.mean.lpips_vgg.map(|v| decimal(v, 4))))
                    (cell(scores.mean.lpips_alex.map(|v| decimal(v, 4))))
                    (cell(scores.gaussians.map(|n| thousands(n.unsigned_abs()))))
                    td { (frames(&scored.target)) }
                }
            }
        }
    };
    html! {
        h3 { "The other scenes" }
        (table(&format!("{} without pictures", count(scenes.len(), "further scene")), &head, body))
    }
}

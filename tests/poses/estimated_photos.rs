//! Photographs without cameras, in memory and in files.

use crate::refused::{EYE, H, STEP, W, camera, picture};
use std::path::PathBuf;
use subsplat::cameras::estimation::PoseRefusal;
use subsplat::reconstruct::{KnownLens, LensSource};
use subsplat::{
    Error, EstimateOptions, LoadOptions, Rgb, estimate_cameras, estimate_cameras_of_files,
    load_photograph, save_png,
};

#[test]
fn photographs_in_memory_get_the_cameras_of_their_files() {
    let folder = tempfile::tempdir().unwrap();
    let cameras = [camera(EYE, 0.0), camera(EYE + STEP, -0.05)];
    let files: Vec<PathBuf> = (0..2)
        .map(|i| {
            let file = folder.path().join(format!("{i}.png"));
            let data = picture(7663, &cameras[i], i as u64);
            save_png(&file, &Rgb { width: W, height: H, data }).unwrap();
            file
        })
        .collect();
    let photographs: Vec<_> =
        files.iter().map(|file| load_photograph(file, &LoadOptions::default()).unwrap()).collect();
    let options =
        EstimateOptions { lens: Some(KnownLens::FovX(1.1)), ..EstimateOptions::default() };

    let scene =
        estimate_cameras_of_files(folder.path(), &files, &options, &mut |_| Ok(())).unwrap();
    let memory = estimate_cameras(photographs.clone(), &options).unwrap();
    assert_eq!(memory.estimate, scene.estimate);
    assert_eq!(memory.lenses, [LensSource::Given, LensSource::Given]);
    assert_eq!(memory.photos.len(), 2);
    for ((photo, photograph), frame) in
        memory.photos.iter().zip(&photographs).zip(&scene.scene.frames)
    {
        assert_eq!((photo.image(), *photo.camera()), (&photograph.image, frame.camera));
    }

    let twice = vec![photographs[0].clone(), photographs[0].clone()];
    let refused = estimate_cameras(twice, &options);
    assert!(
        matches!(&refused, Err(Error::NoPoses { reason: PoseRefusal::SameView { .. }, .. })),
        "{refused:?}"
    );
}

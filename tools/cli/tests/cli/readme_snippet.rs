use subsplat::{DepthBounds, Options, Photo, Reconstructor, Rgb, load_scene, save_png};

pub fn main() -> subsplat::Result<()> {
    let scene = load_scene("examples/room")?;
    let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
    let options = Options::default().with_depth_prior(DepthBounds::of_scene(&scene, &[0, 1])?);
    let model = Reconstructor::shipped(2)?; // or ::load("weights.safetensors", None)
    let room = model.run(&photos, &options)?;
    let picture = room.render(&scene.frames[2].camera); // any camera
    println!("{}x{} pixels from {} Gaussians", picture.width, picture.height, room.splats().len());
    save_png("view.png", &Rgb::from(&picture))?;
    room.save("room.ply").map(drop)
}

//! Cameras of Metashape (XML) and RealityCapture (CSV): known cameras, written as these programs write them, are read
//! back as they were.

use crate::foreign_cameras::{axes, check, opengl_rows, plain, refused, rows, write};
use glam::{DMat3, DVec3};
use std::path::Path;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat::files::poses::find::not_read;
use subsplat::files::poses::scene::{SceneFormat, is_scene, load_cameras, load_scene};
use subsplat::files::poses::{metashape, reality_capture};
use subsplat_kernels::camera::Camera;
use subsplat_test_support::box_room::panorama;

/// The sensors of the tests: text between `<sensors>` and its end.
fn frame_sensor(more: &str) -> String {
    // The cameras of `plain` differ in their focal length: one sensor each.
    let sensor = |i: usize| {
        format!(
            "<sensor id=\"{i}\" label=\"s{i}\" type=\"frame\"><resolution width=\"64\" height=\"48\"/>\
             <calibration type=\"frame\" class=\"initial\"><f>1</f></calibration>\
             <calibration type=\"frame\" class=\"adjusted\"><resolution width=\"64\" height=\"48\"/>\
             <f>{}</f>{more}</calibration></sensor>",
            70.1f32 + i as f32
        )
    };
    (0..6).map(sensor).collect()
}

fn text(numbers: impl IntoIterator<Item = f64>) -> String {
    let words: Vec<String> = numbers.into_iter().map(|v| v.to_string()).collect();
    words.join(" ")
}

/// Rows of the camera-to-chunk matrix whose world under x ↦ scale·R·x + t is that of the camera.
fn in_chunk(camera: &Camera, (r, t, scale): (DMat3, DVec3, f64)) -> String {
    let back = r.transpose();
    let [a, b, c, at] = axes(camera);
    let columns = [back * a, back * b, back * c, back * (at - t) / scale];
    text(rows(columns).as_flattened().iter().copied().chain([0.0, 0.0, 0.0, 1.0]))
}

fn camera(id: usize, label: &str, more: &str, transform: &str) -> String {
    format!("<camera id=\"{id}\" sensor_id=\"{id}\" label=\"{label}\" {more}>{transform}</camera>")
}

fn document(sensors: &str, components: &str, cameras: &str) -> String {
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<document version=\"2.0.0\">\n<chunk label=\"Chunk 1\">\n\
         <sensors next_id=\"6\">{sensors}</sensors>{components}\
         <cameras next_id=\"9\">{cameras}</cameras></chunk></document>"
    )
}

fn transform((r, t, scale): (DMat3, DVec3, f64)) -> String {
    // Rows of R are the columns of its transpose.
    let r = text(r.transpose().to_cols_array());
    format!(
        "<transform><rotation locked=\"true\">{r}</rotation><translation>{}</translation>\
         <scale>{scale}</scale></transform>",
        text(t.to_array())
    )
}

fn similarity(t: DVec3) -> (DMat3, DVec3, f64) {
    (DMat3::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0), t, 12.5)
}

/// The document of `cameras` in a component of a world.
fn exported(cameras: &[NamedCamera], world: (DMat3, DVec3, f64), far: DVec3) -> String {
    let components =
        format!("<components><component id=\"0\">{}</component></components>", transform(world));
    let local = (world.0, world.1 - far, world.2);
    let cameras: String = cameras
        .iter()
        .enumerate()
        .map(|(i, c)| {
            let matrix = format!("<transform>{}</transform>", in_chunk(&c.camera, local));
            camera(i, &format!("{i:03}"), "component_id=\"0\"", &matrix)
        })
        .collect();
    document(&frame_sensor(""), &components, &cameras)
}

#[test]
fn metashape_is_read() {
    let (folder, cameras) = plain(4);
    let world = similarity(DVec3::new(3.0, -2.0, 0.5));
    write(&folder.path().join("my cameras.xml"), exported(&cameras, world, DVec3::ZERO));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Metashape, &cameras);
    assert!(scene.warnings.is_empty() && scene.origin == DVec3::ZERO, "{:?}", scene.warnings);
    assert!(scene.frames.iter().all(|f| f.distortion == Distortion::None));
    let file = folder.path().join("my cameras.xml");
    assert!(load_scene(&file).unwrap().frames == scene.frames);
    assert_eq!(load_cameras(&file).unwrap().frames.len(), 4);
    // UTF-16 with its mark, as an editor of Windows saves.
    let wide = std::fs::read_to_string(&file).unwrap().replace("UTF-8", "UTF-16");
    let wide: Vec<u8> =
        format!("\u{feff}{wide}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    write(&file, wide);
    assert!(load_scene(folder.path()).unwrap().frames == scene.frames);
}

/// A project in geocentric or UTM coordinates has the cameras of one in local coordinates, relative to an origin.
#[test]
fn a_survey_is_its_local_frame() {
    let (folder, cameras) = plain(4);
    let file = folder.path().join("cameras.xml");
    let local = similarity(DVec3::new(3.0, -2.0, 0.5));
    write(&file, exported(&cameras, local, DVec3::ZERO));
    let near = load_scene(folder.path()).unwrap();
    for far in [
        DVec3::new(-2_499_366.25, -4_256_836.5, 4_029_217.75),
        DVec3::new(500_123.0, 5_411_004.0, 213.5),
    ] {
        write(&file, exported(&cameras, (local.0, local.1 + far, local.2), far));
        let scene = load_scene(folder.path()).unwrap();
        assert!(scene.origin.length() > 1e6, "{}", scene.origin);
        assert!(scene.warnings.iter().any(|line| line.contains("relative to")));
        let shift = (scene.origin - far).as_vec3();
        for (frame, near) in scene.frames.iter().zip(&near.frames) {
            let (a, b) = (frame.camera.world_from_camera(), near.camera.world_from_camera());
            let off = a.w_axis.truncate() + shift - b.w_axis.truncate();
            assert!(off.length() < 1e-4, "{off}");
            assert!((0..3).all(|i| (a.col(i) - b.col(i)).length() < 1e-6));
        }
    }
}

/// A file of Metashape without cameras leaves the photographs to the estimation, with a line.
#[test]
fn an_export_without_cameras_is_named_and_not_read() {
    let (folder, _) = plain(3);
    let path = folder.path().join("markers.xml");
    write(&path, r#"<document version="1.2.0"><chunk><sensors/><cameras/></chunk></document>"#);
    assert!(!is_scene(folder.path()));
    let line = not_read(folder.path()).unwrap();
    assert!(
        line.contains("markers.xml") && line.contains("Metashape has exported no cameras"),
        "{line}"
    );
    assert!(load_scene(&path).unwrap_err().to_string().contains("at least one frame"));
}

#[test]
fn sensors_of_metashape() {
    let (folder, cameras) = plain(2);
    let file = folder.path().join("cameras.xml");
    let world = (DMat3::IDENTITY, DVec3::ZERO, 1.0);
    let with = |more: &str, kind: &str| {
        let text = exported(&cameras, world, DVec3::ZERO);
        let text = text.replace(&frame_sensor(""), &frame_sensor(more));
        write(&file, text.replace("type=\"frame\"", &format!("type=\"{kind}\"")));
        load_scene(folder.path())
    };
    let radial = "<k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3>";
    let tangent = "<p1>0.001</p1><p2>-0.002</p2>";
    let k = [-0.1, 0.02, 0.003];
    let scene = with(&format!("<cx>1.5</cx><cy>-2</cy>{radial}{tangent}"), "frame").unwrap();
    let brown = Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], [-0.002, 0.001]);
    assert_eq!(scene.frames[0].distortion, brown);
    let own = scene.frames[0].camera.intrinsics();
    assert_eq!([own.cx, own.cy], [33.5, 22.0]);
    let scene = with(&format!("<b1>2</b1><b2>-0.5</b2><k4>0.2</k4>{radial}{tangent}"), "frame");
    let own = scene.unwrap().frames.remove(1);
    let Distortion::Polynomial { k: found, p, skew } = own.distortion else { panic!("{own:?}") };
    assert_eq!((found, p), ([k[0], k[1], k[2], 0.2], [-0.002, 0.001]));
    assert!((skew + 0.5 / 73.1).abs() < 1e-6, "{skew}");
    let own = own.camera.intrinsics();
    assert!((own.fx - 73.1).abs() < 1e-4 && (own.fy - 71.1).abs() < 1e-4);
    let scene = with(radial, "fisheye").unwrap();
    assert_eq!(scene.frames[0].distortion, Distortion::fisheye([k[0], k[1], k[2], 0.0]));
    let scene = with(&format!("{radial}{tangent}"), "fisheye").unwrap();
    let prism = Distortion::ThinPrismFisheye {
        k: [k[0], k[1], k[2], 0.0],
        p: [-0.002, 0.001],
        s: [0.0; 2],
    };
    assert_eq!(scene.frames[0].distortion, prism);
    for (more, kind, words) in [
        ("", "cylindrical", &["sensor s0", "frame, fisheye or spherical", "`cylindrical`"][..]),
        ("<b2>1</b2>", "fisheye", &["skew of a fisheye", "got 1"]),
        ("<p3>1</p3>", "frame", &["p3 and p4 of 0", "1, 0"]),
        ("<k1>much</k1>", "frame", &["a number in `k1`", "`much`"]),
        ("<k1>nan</k1>", "frame", &["finite distortion"]),
    ] {
        refused(more, with(more, kind), words);
    }
    let old =
        exported(&cameras, world, DVec3::ZERO).replace("<f>", "<fx>").replace("</f>", "</fx>");
    write(&file, old);
    refused("PhotoScan 1.2", load_scene(folder.path()), &["a focal length f", "PhotoScan 1.3"]);
}

#[test]
fn panoramas_of_metashape_are_cut() {
    let (folder, cameras) = plain(2);
    let room = DMat3::IDENTITY;
    for (i, of) in cameras.iter().enumerate() {
        let at = axes(&of.camera)[3] * 0.1;
        let file = folder.path().join(format!("images/00{i}.png"));
        save_png(file, &panorama(128, at, room)).unwrap();
    }
    let world = (DMat3::IDENTITY, DVec3::ZERO, 1.0);
    let sensors: String = (0..2)
        .map(|i| {
            format!(
                "<sensor id=\"{i}\" type=\"spherical\"><resolution width=\"128\" height=\"64\"/></sensor>"
            )
        })
        .collect();
    let text = exported(&cameras, world, DVec3::ZERO).replace(&frame_sensor(""), &sensors);
    write(&folder.path().join("cameras.xml"), text);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 12, "{:?}", scene.warnings);
    let position = scene.frames[6].camera.world_from_camera().w_axis.truncate().as_dvec3();
    assert!((position - axes(&cameras[1].camera)[3]).length() < 1e-5);
}

#[test]
fn cameras_without_a_place_are_left_out() {
    let (folder, cameras) = plain(6);
    let at = |name: &str| folder.path().join(name);
    let world = similarity(DVec3::ONE);
    let own = |i: usize| format!("<transform>{}</transform>", in_chunk(&cameras[i].camera, world));
    let inside = "component_id=\"0\"";
    let absolute = "/another/machine/images/002.png";
    let entries = [
        camera(0, "000.png", inside, &own(0)),
        format!("<group label=\"day 1\">{}</group>", camera(1, "001", inside, &own(1))),
        camera(2, absolute, inside, &own(2)),
        camera(3, "003", "enabled=\"false\"", &own(3)),
        camera(4, "004", "", ""),
        camera(5, "005", "component_id=\"1\"", &own(5)),
    ];
    let components = format!(
        "<components><component id=\"0\">{}</component><component id=\"1\"/></components>",
        transform(world)
    );
    let file = at("cameras.xml");
    let text = document(&frame_sensor(""), &components, &entries.concat());
    write(&file, &text);
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Metashape, &cameras[..3]);
    assert_eq!(scene.frames[2].image, at("images/002.png"));
    let left: Vec<&str> = scene.left_out.iter().map(|left| left.reason.as_str()).collect();
    assert!(left[0].contains("enabled") && left[1].contains("aligned"), "{left:?}");
    assert_eq!(left.len(), 2);
    assert!(scene.warnings.iter().any(|l| l.contains("with 3; the others have 1")));
    // A second chunk with more cameras.
    let more: String = (0..4).map(|i| camera(i, &format!("00{i}"), "", &own(i))).collect();
    let second = format!(
        "<chunk><sensors>{}</sensors><cameras>{more}</cameras>{}</chunk></document>",
        frame_sensor(""),
        transform(world)
    );
    write(&file, text.replace("</document>", &second));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Metashape, &cameras[..4]);
    let line = "with 4; the others have 3, 1";
    assert!(scene.warnings.iter().any(|l| l.contains(line)), "{:?}", scene.warnings);
    // Two cameras with one label: in folders of their groups' names, else in doubt.
    let twins: String = (0..3)
        .map(|i| {
            let label = if i < 2 { "000" } else { "002" };
            format!("<group label=\"g{i}\">{}</group>", camera(i, label, "", &own(i)))
        })
        .collect();
    write(&file, document(&frame_sensor(""), &transform(world), &twins));
    refused("one label", load_scene(folder.path()), &["g0/000", "a label that one camera has"]);
    for i in 0..2 {
        std::fs::create_dir_all(at(&format!("g{i}"))).unwrap();
        std::fs::copy(at(&format!("images/00{i}.png")), at(&format!("g{i}/000.png"))).unwrap();
    }
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Metashape, &cameras[..3]);
}

#[test]
fn hostile_exports() {
    let (_folder, cameras) = plain(2);
    let text = exported(&cameras, similarity(DVec3::ONE), DVec3::ZERO);
    let parse = |text: &str| metashape::parse("c.xml", text.as_bytes());
    assert_eq!(parse(&text).unwrap().cameras.len(), 2);
    for cut in (0..text.len()).step_by(7) {
        refused(&format!("cut at {cut}"), parse(&text[..cut]), &["c.xml"]);
    }
    for (case, from, to, words) in [
        ("scale 0", "<scale>12.5", "<scale>0", &["a scale above 0", "scale 0"][..]),
        ("no number", "<scale>12.5", "<scale>NaN", &["a scale above 0"]),
        ("two scales", "<scale>12.5", "<scale>1 2", &["a number in `scale`", "`1 2`"]),
        ("another root", "document", "calibration", &["document, chunk, cameras", "`calibration`"]),
        ("entities", "<document", "<!DOCTYPE a [<!ENTITY b \"c\">]><document", &["DTD"]),
    ] {
        assert!(text.contains(from), "{case}");
        refused(case, parse(&text.replace(from, to)), words);
    }
    // What is wrong with one camera is that camera's.
    let broken = |from: &str, to: &str| {
        let placed = parse(&text.replacen(from, to, 1)).unwrap().cameras;
        assert!(placed[1].placed.is_ok());
        placed[0].placed.as_ref().unwrap_err().to_string()
    };
    assert!(broken(" 0 0 0 1</transform>", "</transform>").contains("16 numbers in `transform`"));
    assert!(broken("sensor_id=\"0\"", "sensor_id=\"77\"").contains("got 77"));
}

/// A row of RealityCapture for a camera: the angles of its matrix, by their definition.
fn row(name: &str, camera: &Camera) -> String {
    let m = opengl_rows(camera);
    // Rz(−h)·Rx(p)·Ry(r): the third row is (−cos p sin r, sin p, cos p cos r), the second column
    // (sin h cos p, cos h cos p, sin p).
    let pitch = m[2][1].asin();
    let roll = (-m[2][0]).atan2(m[2][2]);
    let heading = m[0][1].atan2(m[1][1]);
    let [h, p, r] = [heading, pitch, roll].map(f64::to_degrees);
    let k = camera.intrinsics();
    // 64 px are the film's 36 mm.
    let focal = f64::from(k.fx) * 36.0 / 64.0;
    let [px, py] = [(k.cx - 32.0) / 64.0, (k.cy - 24.0) / 64.0];
    let t = m.map(|row| row[3]);
    format!("{name},{},{},{},{h},{p},{r},{focal},{px},{py},0,0,0,0,0,0", t[0], t[1], t[2])
}

const HEADER: &str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2";

fn table(cameras: &[NamedCamera]) -> String {
    let name = |c: &NamedCamera| c.file.trim_start_matches("images/").to_owned();
    let rows: Vec<String> = cameras.iter().map(|c| row(&name(c), &c.camera)).collect();
    format!("{HEADER}\r\n{}\r\n", rows.join("\r\n"))
}

#[test]
fn reality_capture_is_read() {
    let (folder, mut cameras) = plain(3);
    let k = cameras[1].camera.intrinsics();
    let k = subsplat_kernels::camera::Intrinsics { cx: 33.25, cy: 22.5, ..k };
    cameras[1].camera = Camera::new(k, cameras[1].camera.world_from_camera()).unwrap();
    let file = folder.path().join("registration.csv");
    write(&folder.path().join("other.csv"), "name,size\na.png,3\n");
    assert!(!is_scene(folder.path()) && not_read(folder.path()).is_none());
    write(&folder.path().join("scan.rcproj"), "");
    assert!(not_read(folder.path()).unwrap().ends_with("export its cameras as CSV"));
    let text = table(&cameras);
    write(&file, &text);
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::RealityCapture, &cameras);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert!(load_scene(&file).unwrap().frames == scene.frames);
    // A line in front, a mark, a quoted name, and columns that are missing or unknown.
    let quoted = text.replace("000.png", "\"C:\\scans, new\\000.png\"");
    write(&file, format!("\u{feff}#cameras 3\n{quoted}"));
    check(&load_scene(folder.path()).unwrap(), SceneFormat::RealityCapture, &cameras);
    let (a, b) = (&cameras[0], &cameras[2]);
    let short = |c: &NamedCamera, name| {
        let row = row(name, &c.camera);
        let words: Vec<&str> = row.split(',').take(8).collect();
        format!("x,{}\n", words.join(","))
    };
    let header = "note,name,x,y,alt,heading,pitch,roll,f\n";
    let text =
        [header, &short(a, "000"), &short(b, "002"), "x,001.png,1,2,much,1,1,1,1\n"].concat();
    write(&file, text);
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::RealityCapture, &[a.clone(), b.clone()]);
    assert!(
        scene.left_out[0].reason.contains("registration.csv:4: expected a finite number `alt`")
    );
}

/// One camera of a user in both exports of RealityCapture (forums.unrealengine.com, "Different rotation of cameras
/// in XMP and CSV"): the rows of the XMP matrix are the camera's axes right, down, forward.
#[test]
fn angles_of_reality_capture_are_those_of_its_matrix() {
    let row = "a.jpg,1,2,3,163.736597399311,83.4154313461628,174.386496244756,30";
    let text = format!("#name,x,y,alt,heading,pitch,roll,f\n{row}\n");
    let rows = reality_capture::parse(Path::new("a.csv"), text.as_bytes()).unwrap();
    let pose = rows[0].camera.as_ref().unwrap().world_from_camera();
    let expected = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296885582437, 0.976472781986697, 0.114],
    ];
    for (i, axis) in expected.into_iter().enumerate() {
        // The last number is rounded in the post.
        let off = pose.col(i).truncate() - DVec3::from_array(axis);
        assert!(off.length() < 2e-4, "{i}: {off}");
    }
    assert_eq!(pose.w_axis.truncate(), DVec3::new(1.0, 2.0, 3.0));
}

#[test]
fn hostile_tables() {
    let parse = |text: &str| reality_capture::parse("c.csv", text.as_bytes());
    refused("empty", parse(""), &["c.csv", "a header with name,x,y,alt"]);
    refused("no roll", parse(&HEADER.replace("roll", "rail")), &["a header with"]);
    assert!(parse(HEADER).unwrap().is_empty());
    let bad = |row: &str| {
        let rows = parse(&format!("{HEADER}\n{row}\n")).unwrap();
        rows[0].camera.as_ref().unwrap_err().to_string()
    };
    assert!(bad("a,1,2").contains("c.csv:2: expected a finite number `alt`, got ``"));
    assert!(bad("a,1,2,3,inf,1,1,1,0,0,0,0,0,0,0,0").contains("`heading`, got `inf`"));
    assert!(bad("a,1,2,3,1,1,1,1,0,0,0,0,0,0,0").contains("`t2`"));
    let radial = parse(&format!("{HEADER}\na,1,2,3,4,5,6,7,0,0,.1,.2,.3,.4,.01,.02\n")).unwrap();
    let found = radial[0].camera.as_ref().unwrap().distortion;
    let expected = Distortion::Polynomial { k: [0.1, 0.2, 0.3, 0.4], p: [0.01, 0.02], skew: 0.0 };
    assert_eq!(found, expected);
}

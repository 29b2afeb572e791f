// What player.js uses of three.js 0.187.0 (MIT, see three.LICENSE). three.bundle.js is made from it, with npm packages three@0.187.0 and esbuild@0.28.2:
//   esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none --target=es2020 --outfile=three.bundle.js
export {
  BoxGeometry, BufferAttribute, BufferGeometry, CanvasTexture, CapsuleGeometry, Color, ConeGeometry, CylinderGeometry, DirectionalLight, DoubleSide, EdgesGeometry, Fog,
  Group, HemisphereLight, LatheGeometry, LineBasicMaterial, LineSegments, Mesh, MeshLambertMaterial, MeshStandardMaterial, PCFShadowMap, PerspectiveCamera,
  PlaneGeometry, Quaternion, RepeatWrapping, SRGBColorSpace, Scene, SphereGeometry, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { Line2 } from "three/examples/jsm/lines/Line2.js";
export { LineGeometry } from "three/examples/jsm/lines/LineGeometry.js";
export { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";

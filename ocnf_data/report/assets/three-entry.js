// The part of three.js (MIT, three-LICENSE.txt) that the page uses. three.min.js was made of it by:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three-entry.js --bundle --minify --format=iife --global-name=THREE --outfile=three.min.js
export {
  Box3, Box3Helper, BufferAttribute, BufferGeometry, Color, DirectionalLight, Group, HemisphereLight, LineBasicMaterial,
  LineSegments, Mesh, MeshLambertMaterial, PerspectiveCamera, Plane, Points, PointsMaterial, Scene, Vector2, Vector3,
  WebGLRenderer, WireframeGeometry,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
